"""All commands with their options."""

import contextlib
import dataclasses
import io
from collections.abc import Callable, Sequence
from functools import reduce
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
from fcos_lidar_jax.cli.checks import check_options, option_name
from fcos_lidar_jax.input_pipeline.open_drive import FOLDER, find_recording


def _detect(args: detect.Detect) -> None:
    """Detect in point files, or like ``stream`` in one recording."""
    if drives := [path for path in args.files if path.exists() and find_recording(path) is not FOLDER]:
        if len(args.files) > 1:
            raise ValueError(f"{drives[0]}: got a recording beside other inputs, expected only the recording")
        stream.run(_as_stream(args), in_lines=False)
    else:
        detect.run(args)


def _as_stream(args: detect.Detect) -> stream.Stream:
    """The options for a recording; rejects options that only point files have."""
    shared = {field.name for field in dataclasses.fields(stream.Stream)}
    for field in dataclasses.fields(detect.Detect):
        if field.name not in {*shared, "files"} and getattr(args, field.name) != field.default:
            raise ValueError(f"{option_name(field.name)}: {args.files[0]}: got a recording, expected point files")
    given = {name: value for name, value in vars(args).items() if name in shared}
    return stream.Stream(source=args.files[0], **given)


_COMMANDS = {
    "demo": (demo.Demo, demo.run, "detect objects in a simulated drive; needs no data"),
    "synthesize": (synthesize.Synthesize, synthesize.run, "write simulated streets in the nuScenes layout"),
    "prepare": (prepare.Prepare, prepare.run, "extract objects for copy-paste; index nuScenes"),
    "train": (train.Train, train.run, "train a detector, or resume a run"),
    "evaluate": (evaluate.Evaluate, evaluate.run, "write metrics, a report and a page of frames"),
    "detect": (detect.Detect, _detect, "write the boxes of point files, or of a recording"),
    "stream": (stream.Stream, stream.run, "write the boxes of a drive, sweep by sweep"),
    "project": (project.Project, project.run, "write the range image of a point file"),
    "export": (export.Export, export.run, "export a detector to a single file, or to ONNX"),
    "benchmark": (benchmark.Benchmark, benchmark.run, "time a detector, stage by stage"),
}  # name -> (options, function, line of the list of commands)


def parse(argv: Sequence[str]) -> Callable[[], object]:
    """Parse the arguments; returns the command, ready to run. Usage errors exit with 2; bad values raise
    ValueError.
    """
    output = io.StringIO()
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            command = _parse(argv)
    except SystemExit as leaving:
        if (rejection := _rejection(leaving)) is not None:
            raise ValueError(rejection) from None
        command = _parse(argv)  # again, to print the help or the usage error
    run = next(run for kind, run, _ in _COMMANDS.values() if isinstance(command, kind))

    def checked() -> None:
        check_options(command)
        run(command)

    return checked


def _parse(argv: Sequence[str]) -> Any:
    # A description would replace the docstring in the help of the command itself.
    listed = not argv or argv[0] not in _COMMANDS
    commands = (
        Annotated[kind, tyro.conf.subcommand(name, description=line if listed else None)]
        for name, (kind, _, line) in _COMMANDS.items()
    )
    command: Any = reduce(or_, commands)
    return tyro.cli(
        command,
        prog="fcos-lidar",
        description="FCOS-LiDAR in JAX: 3D object detection on LiDAR range images.\n\n"
        "fcos-lidar COMMAND --help lists the options of a command, fcos-lidar --version prints the version.",
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
