"""The command line: parse, run, and turn every foreseeable failure into one line."""

import sys
from collections.abc import Callable, Sequence
from functools import reduce
from operator import or_
from typing import Annotated, Any

import tyro

from fcos_lidar_jax.cli import demo, detect, evaluate, prepare, project, synthesize, train

_COMMANDS = {
    "demo": (demo.Demo, demo.run),
    "synthesize": (synthesize.Synthesize, synthesize.run),
    "prepare": (prepare.Prepare, prepare.run),
    "train": (train.Train, train.run),
    "evaluate": (evaluate.Evaluate, evaluate.run),
    "detect": (detect.Detect, detect.run),
    "project": (project.Project, project.run),
}  # name -> its options and what it does

Command: Any = reduce(or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, (kind, _) in _COMMANDS.items()))

_LESS_MEMORY = (
    "in training --optimizer.accumulate N takes a batch in N parts, --model.precision bfloat16 halves the "
    "activations, and --model.remat computes the largest ones again instead of keeping them; elsewhere "
    "--batch-size 1 needs the least"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, by default that of the process's arguments (``argv`` is without the program's name).

    Returns:
        exit code: 0, 1 after a failure that one line on standard error explains, 130 when interrupted. Usage
        errors leave with 2.
    """
    command = tyro.cli(
        Command,
        prog="fcos-lidar",
        description="FCOS-LiDAR in JAX: 3D object detection on LiDAR range images.",
        args=argv,
        config=(tyro.conf.CascadeSubcommandArgs,),  # a command's options may stand behind its preset
    )  # type: ignore[call-overload]
    run = next(run for kind, run in _COMMANDS.values() if isinstance(command, kind))
    return exit_code("fcos-lidar", lambda: run(command))


def exit_code(program: str, work: Callable[[], object]) -> int:
    """Call ``work``; one line on standard error, which begins with the program's name, says why it failed.

    Returns:
        0, 1 after a foreseeable failure, 130 when interrupted.

    >>> exit_code("example", lambda: 0)
    0
    """
    try:
        work()
    except (ValueError, OSError, ArithmeticError) as error:
        line = " ".join(str(error).split())
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        line = f"out of memory: {_LESS_MEMORY}"
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    else:
        return 0
    print(f"{program}: error: {line}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
