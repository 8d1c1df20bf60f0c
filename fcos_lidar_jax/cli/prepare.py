"""``fcos-lidar prepare``: an index of large tables, and the ground-truth database for copy-paste."""

import dataclasses
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import tyro

from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import has_index, open_index, save_index
from fcos_lidar_jax.data.nuscenes.tables import TableError
from fcos_lidar_jax.files import folder_lock
from fcos_lidar_jax.input_pipeline.database import objects_folder, prepare_database
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.progress import Progress


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Make a data set ready for training: cut the objects for copy-paste out of the training split and, for
    nuScenes, make an index of the tables.

    Both are verified when they are opened, and both can be made again at any time. Ctrl-C, or a kill, loses one
    scene of objects at most: the same command resumes.
    """

    data: tyro.conf.OmitArgPrefixes[DataOptions]
    """The data set."""
    train_split: str | None = None
    """Split whose objects are cut out; default: train, or mini_train for a version that ends in mini; all frames
    where the data have no splits. A nuScenes version without annotations gets an index alone."""
    num_sweeps: int = NUSCENES.num_sweeps
    """Sweeps an object's points are taken from, where the data have sweeps."""
    workers: int = 1
    """Processes that cut objects."""


def run(args: Prepare) -> None:
    """Make index and database, and print what there is now."""
    for name in ("workers", "num_sweeps"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')}: got {getattr(args, name)}, expected at least 1")
    layout, began = args.data.layout(), time.monotonic()
    if layout.format == "simulated":
        raise ValueError("--format: got simulated, expected a data set: simulated frames need no preparation")
    folder = args.data.index or layout.index
    with folder_lock(folder, "preparing"):
        record = _prepare(args, folder)
    record["seconds"] = round(time.monotonic() - began, 1)
    print(json.dumps(record))


def _prepare(args: Prepare, folder: Path) -> dict[str, Any]:
    layout = args.data.layout()
    record: dict[str, Any] = {"folder": str(folder)}
    if layout.format == "nuscenes":
        assert layout.version is not None
        _make_index(layout.root / layout.version, folder)
        data = NuScenes(
            layout.root, layout.version, index=folder, allow_missing_sweeps=args.data.allow_missing_sweeps
        )
        record |= {
            "scenes": len(data.index.scene_name),
            "keyframes": len(data.index.sample_token),
            "sweeps": len(data.index.sweep_file),
            "annotations": len(data.index.box_token),
        }
        if not record["annotations"]:
            return record
    split = args.train_split or args.data.split("train")
    frames = args.data.open_whole(split, num_sweeps=args.num_sweeps)
    progress = Progress("frames", len(frames))
    database = prepare_database(
        frames,
        objects_folder(folder, split),
        workers=args.workers,
        report=lambda done, _: progress.show(done),
    )
    return record | {"train_split": split, "frames": len(frames), "objects": len(database)}


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
