"""Shared parts of the scripts: options, errors in one line, folder of the real data, and results files."""

import dataclasses
import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tyro

from experiments.hardware import hardware
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.files import atomic_write

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Base of the options of a script that measures."""

    out: Path | None = None  # JSON file for the figures; default: outputs/SCRIPT.json.


OptionsT = TypeVar("OptionsT", bound=Options)


def run_script(work: Callable[[T], object], options: type[T], description: str | None) -> NoReturn:
    """Parse the options, do the work and exit; an expected failure prints one line.

    The description is shown by ``--help``.
    """
    name = Path(sys.argv[0]).name
    sys.exit(exit_code(name, lambda: work(tyro.cli(options, description=description))))


def run_measurement(
    measure: Callable[[OptionsT], dict[str, Any]], options: type[OptionsT], description: str | None
) -> NoReturn:
    """Like :func:`run_script`, for work whose record is printed and saved."""
    run_script(lambda args: save(measure(args), args.out), options, description)


def save(record: dict[str, Any], out: Path | None, text: str | None = None) -> None:
    """Write a measurement and its hardware as JSON, and print it, or a text instead."""
    written = compact_json({**record, **hardware()})
    print(text or written, flush=True)
    file = out or Path("outputs", f"{Path(sys.argv[0]).stem}.json")
    atomic_write(file, written + "\n")


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Format a table in Markdown, line by line."""
    first, *lines = (f"| {' | '.join(cells)} |" for cells in (header, *rows))
    return [first, "|---" * len(header) + "|", *lines]


def compact_json(value: Any, depth: int = 2) -> str:
    """Format JSON with one line for each value at ``depth`` levels.

    >>> print(compact_json({"car": {"AP": [0.1, 0.2], "truths": 3}, "seed": 0}))
    {
     "car": {
      "AP": [0.1, 0.2],
      "truths": 3
     },
     "seed": 0
    }
    """
    if not depth or not value or not isinstance(value, dict | list):
        return json.dumps(value)
    parts = [compact_json(v, depth - 1) for v in (value.values() if isinstance(value, dict) else value)]
    if isinstance(value, dict):
        parts = [f"{json.dumps(name)}: {part}" for name, part in zip(value, parts, strict=True)]
    first, last = "{}" if isinstance(value, dict) else "[]"
    inside = ",\n".join(parts).replace("\n", "\n ")
    return f"{first}\n {inside}\n{last}"


def find_real_data(folder: Path | None, *parts: str) -> Path | None:
    """Find a file or folder of the real data, below the given folder or the environment's FCOS_LIDAR_REAL_DATA.

    None if neither folder is given; a path that does not exist is refused.
    """
    root = folder or os.environ.get("FCOS_LIDAR_REAL_DATA")
    if not root:
        return None
    path = Path(root, *parts)
    if not path.exists():
        name = "FCOS_LIDAR_REAL_DATA" if folder is None else "--data"
        raise ValueError(f"{name}: {root}: no {'/'.join(parts)} there")
    return path


def real_data(folder: Path | None, part: str) -> Path:
    """Like :func:`find_real_data`, with a ValueError if no folder is given."""
    path = find_real_data(folder, part)
    if path is None:
        raise ValueError(f"--data: missing, expected the folder that holds {part}/")
    return path
