"""Scenes of the training and test splits."""

import ast
import importlib.util
from pathlib import Path

from fcos_lidar_jax.data.splits import SPLITS, own_splits

OFFICIAL = ("train", "val", "test", "mini_train", "mini_val")
"""Splits of the official devkit, which lists their scenes in its source."""


def scenes_of_split(split: str, tables: str | Path, *, file: str | Path | None = None) -> list[str]:
    """Scene names of a split.

    Reads the given file or else the version's own ``splits.json``. Official splits are also looked up in the
    source of an installed devkit, which is parsed and never imported.

    Args:
        split: name of the split.
        tables: ``ROOT/VERSION``.
        file: ``{"name": ["scene", ...]}``.

    Raises:
        ValueError: the split is unknown or has no scene.
    """
    path, splits = Path(file or Path(tables) / SPLITS), own_splits(Path(tables), file)
    places = [f"{path} ({', '.join(splits)})" if splits else str(path)]
    if file is None and split not in splits and split in OFFICIAL:
        splits = _devkit_splits()
        places.insert(0, "the source of an installed nuscenes-devkit")
    if split not in splits:
        hint = "you can pass a file {name: [scene, ...]}"
        raise ValueError(f"split {split!r}: not found in {' or in '.join(places)}; {hint}")
    if not splits[split]:
        raise ValueError(f"{path}: {split}: got no scene, expected at least one")
    return splits[split]


def _devkit_splits() -> dict[str, list[str]]:
    """The official splits in the devkit's ``utils/splits.py``; empty if no devkit is installed."""
    spec = importlib.util.find_spec("nuscenes")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    files = [file for folder in folders if (file := Path(folder) / "utils" / "splits.py").is_file()]
    if not files:
        return {}
    splits: dict[str, list[str]] = {}
    for node in ast.parse(files[0].read_text(encoding="utf-8")).body:
        names = [t.id for t in getattr(node, "targets", []) if isinstance(t, ast.Name)]
        value = getattr(node, "value", None)
        if names and isinstance(value, ast.List):
            splits[names[0]] = ast.literal_eval(value)
    if "train" not in splits and {"train_detect", "train_track"} <= set(splits):
        splits["train"] = sorted({*splits["train_detect"], *splits["train_track"]})
    return {name: scenes for name, scenes in splits.items() if name in OFFICIAL}
