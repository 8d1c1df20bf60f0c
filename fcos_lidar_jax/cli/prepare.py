"""``fcos-lidar prepare``: an index of large tables, and the ground-truth database for copy-paste."""

import dataclasses
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import tyro

from fcos_lidar_jax.cli.checks import check_at_least, check_out_folder
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import Index, has_index, open_index, save_index
from fcos_lidar_jax.data.nuscenes.tables import TableError
from fcos_lidar_jax.files import folder_lock
from fcos_lidar_jax.input_pipeline.database import cut_reading, objects_folder, prepare_database
from fcos_lidar_jax.input_pipeline.open import DataSet
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.progress import Progress


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Make a data set ready for training: cut the objects for copy-paste out of the training split and, for
    nuScenes, make an index of the tables.

    Both are verified when they are opened, and both can be made again at any time. Ctrl-C, or a kill, loses one
    scene of objects at most: the same command resumes.
    """

    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    train_split: str | None = None
    """Split whose objects are cut out; default: train, or mini_train for a version that ends in mini; all frames
    where the data have no splits. A nuScenes version without annotations gets an index alone."""
    num_sweeps: int = NUSCENES.num_sweeps  # Sweeps an object's points are taken from, where the data have sweeps.
    min_points: int = CopyPasteConfig().min_points
    """Points, of all its sweeps, that an object needs; a training may ask for more by copy_paste.min_points."""
    workers: int = 1  # Processes that cut objects.


def run(args: Prepare) -> None:
    """Make index and database, and print what there is now."""
    check_at_least(args, 1, "workers", "num_sweeps", "min_points")
    data, began = args.data.find(), time.monotonic()
    if not data.on_disk:
        raise ValueError("--format: got simulated, expected a data set: simulated frames need no preparation")
    folder = args.data.index or data.index
    check_out_folder(folder, "--index")
    with folder_lock(folder, "preparing"):
        record = _prepare(args, data, folder)
    record["seconds"] = round(time.monotonic() - began, 1)
    print(json.dumps(record))


def _prepare(args: Prepare, data: DataSet, folder: Path) -> dict[str, Any]:
    record: dict[str, Any] = {"folder": str(folder)}
    if data.tables is not None:
        index = _make_index(data.tables, folder)
        record |= {"scenes": len(index.scene_name), "keyframes": len(index.sample_token)}
        record |= {"sweeps": len(index.sweep_file), "annotations": len(index.box_token)}
        if not record["annotations"]:
            return record
    split = args.train_split or args.data.split("train")
    frames = args.data.open_whole(split, cut_reading(args.num_sweeps))
    progress = Progress("frames", len(frames))
    objects = objects_folder(folder, split)
    options = {"min_points": args.min_points, "workers": args.workers}
    database = prepare_database(frames, objects, **options, report=lambda done, _: progress.show(done))
    return record | {"train_split": split, "frames": len(frames), "objects": len(database)}


def _make_index(tables: Path, folder: Path) -> Index:
    """The index in the folder, made anew unless there is one that fits."""
    if has_index(folder):
        try:
            return open_index(folder, tables=tables)
        except TableError as error:
            print(f"{error}: making it anew", file=sys.stderr)
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
    return open_index(folder, tables=tables)
