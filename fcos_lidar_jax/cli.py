"""The command line: parse, run, and turn every foreseeable failure into one line."""

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from fcos_lidar_jax.commands import demo, detect, project

_DESCRIPTION = "FCOS-LiDAR in JAX: 3D object detection on LiDAR range images."

Command = (
    Annotated[demo.Demo, tyro.conf.subcommand("demo")]
    | Annotated[detect.Detect, tyro.conf.subcommand("detect")]
    | Annotated[project.Project, tyro.conf.subcommand("project")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: arguments without the program's name; the process's by default.

    Returns:
        exit code: 0, 1 after a failure that one line on standard error explains, 130 when interrupted. Usage
        errors leave with 2.
    """
    command = tyro.cli(Command, prog="fcos-lidar", description=_DESCRIPTION, args=argv)  # type: ignore[call-overload]
    try:
        if isinstance(command, demo.Demo):
            demo.run(command)
        elif isinstance(command, detect.Detect):
            detect.run(command)
        else:
            project.run(command)
    except (ValueError, OSError, ArithmeticError) as error:
        line = " ".join(str(error).split())
        print(f"fcos-lidar: error: {line}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("fcos-lidar: interrupted", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
