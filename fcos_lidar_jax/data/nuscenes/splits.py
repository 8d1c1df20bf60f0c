"""Which scenes are trained on and which are tested."""

import ast
import importlib.util
import json
from pathlib import Path

OFFICIAL = ("train", "val", "test", "mini_train", "mini_val")
"""Names that the official devkit defines; it lists their scenes in its source."""


class SplitError(ValueError):
    """A split that cannot be had; the message names it, where it was looked for and what there is."""


def scenes_of_split(split: str, tables: str | Path, *, file: str | Path | None = None) -> list[str]:
    """Scene names of a split.

    Looked for in the file that is given, or else in the version's own ``splits.json``, or else, for the official
    names, in the source of an installed devkit, which is read and never imported.

    Args:
        split: its name.
        tables: ``ROOT/VERSION``.
        file: ``{"name": ["scene", ...]}``.

    Raises:
        SplitError: there is no such split, or it has no scene.
    """
    own = Path(tables) / "splits.json"
    places: list[str] = []
    if file is not None or own.is_file():
        path, named = own if file is None else Path(file), own_splits(tables, file)
        if split in named:
            if not named[split]:
                raise SplitError(f"{path}: {split}: got no scene, expected at least one")
            return named[split]
        places.append(f"{path} ({', '.join(named) or 'no split'})")
    if file is None and split in OFFICIAL:
        official = _devkit_splits()
        if split in official:
            return official[split]
        places.append("the source of an installed nuscenes-devkit")
    if file is None and not own.is_file():
        places.append(str(own))
    raise SplitError(
        f"split {split!r}: not found in {' or in '.join(places)}; a file {{name: [scene, ...]}} can be given"
    )


def own_splits(tables: str | Path, file: str | Path | None = None) -> dict[str, list[str]]:
    """The splits of a file, or of the version's own ``splits.json``; none where there is no such file."""
    path = Path(tables) / "splits.json" if file is None else Path(file)
    return _read_splits(path) if file is not None or path.is_file() else {}


def _read_splits(path: Path) -> dict[str, list[str]]:
    if not path.is_file():
        raise SplitError(f"{path}: no such file, expected splits")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SplitError(f"{path}: not JSON: {error}") from None
    if not isinstance(record, dict):
        raise SplitError(f"{path}: got {type(record).__name__}, expected {{name: [scene, ...]}}")
    for name, scenes in record.items():
        if not isinstance(scenes, list) or not all(isinstance(scene, str) for scene in scenes):
            raise SplitError(f"{path}: {name}: expected a list of scene names")
    return record


def _devkit_splits() -> dict[str, list[str]]:
    """The lists assigned in the devkit's ``utils/splits.py``, empty where no devkit is installed."""
    found = importlib.util.find_spec("nuscenes")
    folders = list(found.submodule_search_locations or ()) if found else []
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
