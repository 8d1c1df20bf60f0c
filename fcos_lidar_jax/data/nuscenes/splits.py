"""Scenes of the training and test splits."""

import functools
import tomllib
from collections.abc import Collection
from pathlib import Path

from fcos_lidar_jax.data.splits import SPLITS, own_splits


@functools.cache
def official_splits() -> dict[str, list[str]]:
    """The official splits, by name."""
    splits = tomllib.loads(Path(__file__).with_name("splits.toml").read_text(encoding="utf-8"))
    return {name: [scene for span in text.split() for scene in _scenes(span)] for name, text in splits.items()}


def _scenes(span: str) -> list[str]:
    first, _, last = span.partition("-")
    return [f"scene-{number:04d}" for number in range(int(first), int(last or first) + 1)]


def scenes_of_split(
    split: str, tables: str | Path, known: Collection[str], *, file: str | Path | None = None
) -> list[str]:
    """Scene names of a split in the given file, else in the version's ``splits.json``, else of an official split.

    An unknown split and scenes that are not ``known`` are refused.
    """
    path, splits = Path(file or Path(tables) / SPLITS), own_splits(Path(tables), file)
    hint = "you can pass a file {name: [scene, ...]}"
    if file is None and split not in splits and split in official_splits():
        splits = official_splits()
    if split not in splits:
        names = ", ".join(splits or official_splits())
        raise ValueError(f"split {split!r}: not found in {path}, expected one of {names}; {hint}")
    for scene in splits[split]:
        if scene not in known:
            raise ValueError(f"split {split!r}: {scene}: no such scene in {Path(tables) / 'scene.json'}; {hint}")
    return splits[split]
