"""All commands with their options."""

import contextlib
import dataclasses
import io
from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import tyro

from fcos_lidar_jax.cli import (
    benchmark,
    demo,
    detect,
    evaluate,
    export,
    prepare,
    project,
    stream,
    synthesize,
    train,
)
from fcos_lidar_jax.files import local_path

_COMMANDS = {
    "demo": (demo.Demo, demo.run),
    "synthesize": (synthesize.Synthesize, synthesize.run),
    "prepare": (prepare.Prepare, prepare.run),
    "train": (train.Train, train.run),
    "evaluate": (evaluate.Evaluate, evaluate.run),
    "detect": (detect.Detect, detect.run),
    "stream": (stream.Stream, stream.run),
    "project": (project.Project, project.run),
    "export": (export.Export, export.run),
    "benchmark": (benchmark.Benchmark, benchmark.run),
}  # name -> (options, function)

Command: Any = reduce(or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, (kind, _) in _COMMANDS.items()))


def parse(argv: Sequence[str] | None) -> Callable[[], object]:
    """Parse the arguments; returns the command, ready to run. Usage errors exit with 2.

    Raises:
        ValueError: a configuration rejects a value, or an option is a URL.
    """
    output, rejection, command = io.StringIO(), None, None
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            command = _parse(argv)
    except SystemExit as leaving:
        rejection = _rejection(leaving)
    if rejection is not None:
        raise ValueError(rejection)
    if command is None:
        command = _parse(argv)  # again, to print the help or the usage error
    _check_paths(command)
    run = next(run for kind, run in _COMMANDS.values() if isinstance(command, kind))
    return partial(run, command)


def _check_paths(value: Any) -> None:
    """Reject URLs in all options of a command."""
    if isinstance(value, str | Path):
        local_path(value)
    elif isinstance(value, tuple):
        for part in value:
            _check_paths(part)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            _check_paths(getattr(value, field.name))


def _parse(argv: Sequence[str] | None) -> Any:
    return tyro.cli(
        Command,
        prog="fcos-lidar",
        description="FCOS-LiDAR in JAX: 3D object detection on LiDAR range images.",
        args=argv,
        config=(tyro.conf.CascadeSubcommandArgs,),  # options of a command may follow its preset
    )  # type: ignore[call-overload]


def _rejection(leaving: SystemExit) -> str | None:
    """The configuration's message about a value, with the option's name; None for other usage errors.

    tyro would print such a message in a frame of several lines, under a name of its own.
    """
    place, error = getattr(leaving.__context__, "arg", None), getattr(leaving.__context__, "__context__", None)
    parts = place.split(".") if isinstance(place, str) else []
    if "config" not in parts or not isinstance(error, ValueError):
        return None
    field, _, message = str(error).partition(": ")
    path = [*parts[parts.index("config") + 1 :], field]
    return f"--{'.'.join(path).replace('_', '-')}: {message}"
