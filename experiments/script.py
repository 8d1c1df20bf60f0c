"""What the scripts share: options, one line for a failure, the real data's folder, the record of a measurement."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tyro

from experiments.hardware import hardware
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.files import atomic_write

T = TypeVar("T")


def run_script(work: Callable[[T], object], options: type[T], description: str | None) -> NoReturn:
    """Parse the options, do the work and leave with the exit code; a foreseeable failure is one line.

    Args:
        work: what to do with the options.
        options: dataclass of the options.
        description: of the script, for ``--help``.
    """
    name = Path(sys.argv[0]).name
    sys.exit(exit_code(name, lambda: work(tyro.cli(options, description=description))))


def real_data(folder: Path | None, *parts: str, option: str = "--data") -> Path | None:
    """A file or folder of the real data.

    Args:
        folder: of the real data; None for the one that the environment names, if it does.
        parts: of the path below it.
        option: that names the folder, for the message.

    Returns:
        its path; None where no folder is named at all.

    Raises:
        ValueError: it is not there.
    """
    root = folder or os.environ.get("FCOS_LIDAR_REAL_DATA")
    if not root:
        return None
    path = Path(root, *parts)
    if not path.exists():
        name = "FCOS_LIDAR_REAL_DATA" if folder is None else option
        raise ValueError(f"{name}: {root}: no {'/'.join(parts)} there")
    return path


def save(record: dict[str, Any], out: Path, text: str | None = None) -> None:
    """Write a measurement as JSON, with the machine it was made on, and print it.

    Args:
        record: what was measured.
        out: file to write.
        text: to print in place of the JSON.
    """
    written = json.dumps({**record, **hardware()}, indent=1)
    print(text or written, flush=True)
    atomic_write(out, lambda path: path.write_text(written + "\n", encoding="utf-8"))
