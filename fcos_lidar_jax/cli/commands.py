"""All commands: their options, and what each does."""

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
    """The command of some arguments, ready to run; usage errors leave with 2."""
    command = tyro.cli(
        Command,
        prog="fcos-lidar",
        description="FCOS-LiDAR in JAX: 3D object detection on LiDAR range images.",
        args=argv,
        config=(tyro.conf.CascadeSubcommandArgs,),  # a command's options may stand behind its preset
    )  # type: ignore[call-overload]
    run = next(run for kind, run in _COMMANDS.values() if isinstance(command, kind))
    return partial(run, command)
