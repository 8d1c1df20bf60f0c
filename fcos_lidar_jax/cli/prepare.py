"""``fcos-lidar prepare``: the ground-truth database for copy-paste, and the index of nuScenes' tables."""

import collections
import dataclasses
import json
import re
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.folder import belongs_to_own_data
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import Index, has_index, open_index, save_index
from fcos_lidar_jax.fields import Count
from fcos_lidar_jax.files import check_writable, folder_lock, refusing
from fcos_lidar_jax.input_pipeline.database import cut_reading, objects_folder, prepare_database
from fcos_lidar_jax.input_pipeline.open import DataSet
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.progress import Progress, tell


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Prepare a data set for training: extract objects for copy-paste from the training split and, for nuScenes,
    index the tables.

    Objects and index are verified whenever they are opened, and can be rebuilt. A training that runs meanwhile
    stops if its objects change, and resumes after they are prepared as before. After Ctrl-C or a kill, the same
    command resumes and repeats at most one scene of objects per worker.
    """

    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    train_split: Annotated[
        str | None,
        option("SPLIT", default="train, mini_train, or all frames without splits", aliases=("--split",)),
    ] = None
    """Split to extract objects from. A nuScenes version without annotations only gets an index."""
    num_sweeps: Count = NUSCENES.num_sweeps  # Sweeps per object, if the data have sweeps.
    min_points: Count = CopyPasteConfig().min_points
    """Minimum number of points of an object in all its sweeps; --copy-paste.min-points of train may be higher."""
    workers: Count = 1  # Processes that extract objects.


def run(args: Prepare) -> None:
    """Build the index and the database, and print a record of them."""
    data, began = args.data.data_set, time.monotonic()
    if not data.on_disk:
        raise ValueError("--format: got simulated, expected a data set: simulated frames need no preparation")
    folder = args.data.index or data.index
    more = "; name one by --index, here and for train"
    with refusing("--index", PermissionError, kind=PermissionError, more=more):
        check_writable(folder / ".lock")
    if belongs_to_own_data(folder / "objects"):
        raise ValueError(f"--index: {folder}: a folder of own data, expected another one")
    jax.config.update("jax_platforms", "cpu")  # accelerators are not needed, and may be in use
    tell(f"writing to {folder}" + ("" if args.data.index else "; --index names another folder"))
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
    split = args.data.split("train", args.train_split)
    frames = args.data.open_whole(split, cut_reading(args.num_sweeps))
    progress = Progress("frames", len(frames))
    objects = objects_folder(folder, split)
    options = {name: getattr(args, name) for name in ("min_points", "num_sweeps", "workers")}
    database = prepare_database(frames, objects, **options, report=lambda done, _: progress.show(done))
    return record | {"train_split": split, "frames": len(frames), "objects": len(database)}


def _make_index(tables: Path, folder: Path) -> Index:
    """Open the index in the folder; build it if it is missing or does not fit the tables."""
    if has_index(folder):
        try:
            return open_index(folder, tables=tables)
        except ValueError as error:
            tell(f"{error}: rebuilding it")
    for left_over in folder.glob(".*"):
        if re.fullmatch(r"\.[0-9a-f]{12}\.(npy|json)", left_over.name):  # of a killed process
            left_over.unlink()
    progress = collections.defaultdict[str, Progress](lambda: Progress("rows", None, every_s=5.0))
    index = build_index(tables, lambda file, rows: progress[file].show(rows, file))
    save_index(index, folder, tables=tables)
    return open_index(folder, tables=tables)
