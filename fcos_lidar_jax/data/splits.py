"""Splits: named lists of scenes or frames."""

from collections.abc import Collection, Iterable
from pathlib import Path

from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import read_json

SPLITS = "splits.json"


def own_splits(folder: Path, file: str | Path | None = None) -> dict[str, list[str]]:
    """The splits in a file, by default the folder's ``splits.json``; empty if that is missing."""
    if file is None and not (folder / SPLITS).exists():
        return {}
    return read_json(Path(file or folder / SPLITS), dict[str, list[str]], what="splits")


def distinct_names(listed: Iterable[tuple[str, str]], known: Collection[str], where: str) -> tuple[str, ...]:
    """Check a list of frame names: at least one, each known and listed once.

    ``listed`` pairs the place of each name, for messages, with the name; ``where`` is the place of the list.
    """
    names: list[str] = []
    left = set(known)
    for place, name in listed:
        check(name in left, place, name, "the name of a cloud, each once")
        left.remove(name)
        names.append(name)
    if not names:
        raise ValueError(f"{where}: no frame in it, expected at least one")
    return tuple(names)
