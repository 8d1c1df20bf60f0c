"""``fcos-lidar prepare``: from the official tables to an index and an object database."""

import dataclasses
import json
import re
import sys
import time
from itertools import groupby
from pathlib import Path
from typing import Any

from fcos_lidar_jax.config import NUSCENES, CopyPasteConfig
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import has_index, open_index, save_index
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames, default_index
from fcos_lidar_jax.data.nuscenes.tables import TableError
from fcos_lidar_jax.data.object_builder import build_objects
from fcos_lidar_jax.data.objects import ObjectDatabase, checksum
from fcos_lidar_jax.progress import Progress


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Make a data set in the nuScenes layout ready for training: an index of its tables, and the objects for
    copy-paste, cut out of the training split.

    Both are verified when they are opened, and both can be made again at any time. Ctrl-C, or a kill, loses one
    scene of objects at most: the same command goes on.
    """

    data_root: Path
    """Folder with the version's folder, samples/ and sweeps/."""
    version: str
    """Folder of the tables, such as v1.0-trainval."""
    index: Path | None = None
    """Where the index goes; default: DATA_ROOT/.fcos_lidar/VERSION."""
    train_split: str | None = None
    """Split whose objects are cut out; default: mini_train for a version that ends in mini, else train. A version
    without annotations gets an index alone."""
    splits: Path | None = None
    """File {name: [scene, ...]} with own splits; default: the version's splits.json or the official ones."""
    num_sweeps: int = NUSCENES.num_sweeps
    """Sweeps an object's points are taken from."""
    workers: int = 1
    """Processes that cut objects."""
    allow_missing_sweeps: bool = False
    """Go on with fewer sweeps where files of older sweeps are missing; they are counted."""


def run(args: Prepare) -> None:
    """Do it, and print what there is now."""
    for name in ("workers", "num_sweeps"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')}: got {getattr(args, name)}, expected at least 1")
    folder = args.index or default_index(args.data_root, args.version)
    began = time.monotonic()
    _make_index(args.data_root / args.version, folder)
    data = NuScenes(args.data_root, args.version, index=folder, allow_missing_sweeps=args.allow_missing_sweeps)
    record: dict[str, Any] = {
        "index": str(folder),
        "scenes": len(data.index.scene_name),
        "keyframes": len(data.index.sample_token),
        "sweeps": len(data.index.sweep_file),
        "annotations": len(data.index.box_token),
    }
    if len(data.index.box_token):
        split = args.train_split or default_train_split(args.version)
        tokens = data.split(split, file=args.splits)
        missing = data.missing_sweeps(tokens, args.num_sweeps)
        if missing:
            print(f"{missing} sweep files of split {split!r} are missing", file=sys.stderr)
        objects = _cut_objects(data, folder, split, tokens, args)
        record |= {"train_split": split, "train_keyframes": len(tokens), "missing_sweep_files": missing}
        record["objects"] = len(objects)
    record["seconds"] = round(time.monotonic() - began, 1)
    print(json.dumps(record))


def default_train_split(version: str) -> str:
    """The official name of a version's training split.

    >>> default_train_split("v1.0-mini"), default_train_split("v1.0-trainval")
    ('mini_train', 'train')
    """
    return "mini_train" if version.endswith("mini") else "train"


def objects_folder(index: Path, split: str) -> Path:
    """Where the objects of a split are, below the index: those of another split never get into a training."""
    return index / "objects" / split


def fingerprint(index: Path, frames: NuScenesFrames) -> str:
    """What the objects follow from, in short: all columns of the index, which keyframes, and how they are read."""
    manifest = json.loads((index / "index.json").read_text(encoding="utf-8"))
    columns = [(name, column["blake2b"]) for name, column in manifest["columns"].items()]
    how = frames.num_sweeps, frames.remove_close, frames.close_m
    return checksum(repr((columns, frames.tokens, how)).encode())


def _make_index(tables: Path, folder: Path) -> None:
    if has_index(folder):
        try:
            open_index(folder, tables=tables)
        except TableError as error:
            print(f"{error}: making it anew", file=sys.stderr)
        else:
            return
    for left_over in folder.glob(".*"):
        if re.fullmatch(r"\.[0-9a-f]{12}\.(npy|json)", left_over.name):  # of a killed run
            left_over.unlink()
    began = last = time.monotonic()

    def report(file: str, rows: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now > last + 5:
            last = now
            print(f"{file}: {rows} rows, {now - began:.0f} s", file=sys.stderr, flush=True)

    save_index(build_index(tables, report), folder, tables=tables)


def _cut_objects(data: NuScenes, folder: Path, split: str, tokens: list[str], args: Prepare) -> ObjectDatabase:
    frames = NuScenesFrames(data, tuple(tokens), num_sweeps=args.num_sweeps)
    by_scene = groupby(range(len(tokens)), key=lambda i: data.scene_of(tokens[i]))
    progress = Progress("keyframes", len(tokens))
    return build_objects(
        frames,
        objects_folder(folder, split),
        shards=[(scene, list(indices)) for scene, indices in by_scene],
        fingerprint=fingerprint(folder, frames),
        min_points=CopyPasteConfig().min_points,
        workers=args.workers,
        report=lambda done, _: progress.show(done),
    )
