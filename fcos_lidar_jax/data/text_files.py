"""Text files of numbers: lines with their place for messages, finite numbers, named matrices."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.sweeps import is_rotation
from fcos_lidar_jax.files import expect_file, refusing

_LARGEST = float(np.finfo(np.float32).max)


def read_lines(file: Path, what: str = "text") -> list[tuple[str, list[str]]]:
    """The place of each line, for messages, and its words; blank lines are skipped.

    ``what`` describes the expected file, if there is none or it is not text.
    """
    expect_file(file, what)
    with refusing(f"{file}: expected {what}", UnicodeDecodeError):
        lines = file.read_text(encoding="utf-8-sig").splitlines()  # Windows editors write a byte order mark
    rows = ((f"{file}: line {i}", line.split()) for i, line in enumerate(lines, start=1))
    return [(where, words) for where, words in rows if words]


def read_number(word: str, where: str, *, largest: float = _LARGEST) -> float:
    """A finite number of at most ``largest`` in magnitude."""
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not abs(value) <= largest:
        raise ValueError(f"{where}: got {word!r}, expected a finite number of at most {largest:g}")
    return value


def read_matrices(
    file: Path, shapes: Mapping[str, tuple[int, int]], rotations: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Read matrices from lines ``NAME: NUMBER NUMBER ...``; lines of other names are skipped.

    ``shapes`` are the names of all required matrices with their rows and columns. ``rotations`` are those that
    begin with a 3x3 rotation.
    """
    matrices = {}
    for where, (name, *words) in read_lines(file):
        if (name := name.removesuffix(":")) not in shapes:
            continue
        where = f"{where}: {name}"
        numbers = np.array([read_number(word, where) for word in words])
        with refusing(where, ValueError):
            matrices[name] = numbers.reshape(shapes[name])
        if name in rotations and not is_rotation(matrices[name][:, :3]):
            raise ValueError(f"{where}: got no rotation in its 3x3, expected orthonormal rows")
    for name in shapes:
        if name not in matrices:
            raise ValueError(f"{file}: {name}: missing, expected {', '.join(shapes)}")
    return matrices
