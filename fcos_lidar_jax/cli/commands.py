"""All commands: their options, and what each does."""

import contextlib
import io
from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import or_
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
}  # name -> its options and what it does

Command: Any = reduce(or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, (kind, _) in _COMMANDS.items()))


def parse(argv: Sequence[str] | None) -> Callable[[], object]:
    """The command of some arguments, ready to run; usage errors leave with 2.

    Raises:
        ValueError: a configuration refuses an option's value.
    """
    unread, refused, command = io.StringIO(), None, None
    try:
        with contextlib.redirect_stdout(unread), contextlib.redirect_stderr(unread):
            command = _parse(argv)
    except SystemExit as leaving:
        refused = _refused_value(leaving)
    if refused is not None:
        raise ValueError(refused)
    if command is None:
        command = _parse(argv)  # Once more, to be read: help, or what is wrong with the usage.
    run = next(run for kind, run in _COMMANDS.values() if isinstance(command, kind))
    return partial(run, command)


def _parse(argv: Sequence[str] | None) -> Any:
    return tyro.cli(
        Command,
        prog="fcos-lidar",
        description="FCOS-LiDAR in JAX: 3D object detection on LiDAR range images.",
        args=argv,
        config=(tyro.conf.CascadeSubcommandArgs,),  # a command's options may stand behind its preset
    )  # type: ignore[call-overload]


def _refused_value(leaving: SystemExit) -> str | None:
    """What a configuration says about a value, with the name of its option; None where something else is wrong.

    tyro shows such an error under a name of its own, in a frame of several lines.
    """
    place, error = getattr(leaving.__context__, "arg", None), getattr(leaving.__context__, "__context__", None)
    parts = place.split(".") if isinstance(place, str) else []
    if "config" not in parts or not isinstance(error, ValueError):
        return None
    field, _, said = str(error).partition(": ")
    path = [*parts[parts.index("config") + 1 :], field]
    return f"--{'.'.join(path).replace('_', '-')}: {said}"
