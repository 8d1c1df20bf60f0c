"""Resumable export of a synthetic data set: first the scenes, then the tables.

``OUT/.synthesize`` contains the specification of the data set and, until the folder of tables appears, the rows of
finished scenes.
"""

import dataclasses
import itertools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import atomic_folder, atomic_write, folder_lock, naming, read_json
from fcos_lidar_jax.simulation.nuscenes_tables import CHANNEL, MAP_FILE, fixed_tables, scene_name
from fcos_lidar_jax.simulation.render import DatasetSpec, render_scene
from fcos_lidar_jax.workers import run_jobs

_WORK = ".synthesize"
_ORDER, _SHARDS = f"{_WORK}/order.json", f"{_WORK}/scenes"
_FORMAT = 3  # increases when the bytes of the same specification change


def write_dataset(spec: DatasetSpec, root: Path, *, workers: int, report: Callable[[int], object]) -> bool:
    """Write a data set in the official layout, or resume an unfinished one; False if it was already complete.

    The folder is new, empty, or has an unfinished data set of the same specification; others are refused. The
    bytes do not depend on the number of worker processes. ``report`` gets the number of finished sweeps; several
    workers report whole scenes.
    """
    order, finished = _check_order(spec, root), (root / spec.version).is_dir()
    if finished and not (root / _SHARDS).is_dir():
        return False
    with folder_lock(root / _WORK, "synthesizing"):
        if not finished:
            atomic_write(root / _ORDER, json.dumps(order, indent=1) + "\n")
            _write_scenes(spec, root, workers, report)
            _write_tables(spec, root)
        shutil.rmtree(root / _SHARDS, ignore_errors=True)
    return not finished


def _check_order(spec: DatasetSpec, root: Path) -> dict[str, Any]:
    """Specification of the data set as JSON; refuses a folder with other contents."""
    order = {"format": _FORMAT, **dataclasses.asdict(spec)}
    del order["sensor"]["forward_rad"]  # changes no file
    if (root / _ORDER).is_file():
        begun, wanted = read_json(root / _ORDER, dict[str, Any]), json.loads(json.dumps(order))
        if other := [name for name in wanted if begun.get(name) != wanted[name]]:
            raise ValueError(f"{root}: found a data set begun with another {', '.join(other)}, expected the same")
    elif root.exists() and (not root.is_dir() or any(p.name != _WORK for p in root.iterdir())):
        raise ValueError(f"{root}: found other files, expected an empty folder or a data set of this command")
    return order


def _shard(root: Path, index: int) -> Path:
    return root / _SHARDS / scene_name(index)


def _write_scenes(spec: DatasetSpec, root: Path, workers: int, report: Callable[[int], object]) -> None:
    for folder in (f"samples/{CHANNEL}", f"sweeps/{CHANNEL}", Path(MAP_FILE).parent):
        (root / folder).mkdir(parents=True, exist_ok=True)
    todo = [index for index in range(spec.scenes) if not _shard(root, index).is_dir()]
    done = (spec.scenes - len(todo)) * spec.sweeps
    count = itertools.count(done + 1)
    advance = (lambda: report(next(count))) if workers == 1 else _keep_silent
    for sweeps in run_jobs(_write_scene, (spec, root, advance), todo, workers):
        done += sweeps
        if workers > 1:
            report(done)


def _keep_silent() -> None:
    """Report nothing, in worker processes."""


def _write_scene(shared: tuple[DatasetSpec, Path, Callable[[], object]], index: int) -> int:
    spec, root, advance = shared
    rows = render_scene(spec, index, root, advance)
    with atomic_folder(_shard(root, index)) as folder:
        for name, table in rows.items():  # the text of the final table without its brackets
            atomic_write(folder / f"{name}.json", json.dumps(table, indent=0)[1:-1].strip("\n"))
    return spec.sweeps


def _write_tables(spec: DatasetSpec, root: Path) -> None:
    """Write all tables from the rows of the scenes, one scene in memory at a time."""
    atomic_write(root / MAP_FILE, "")
    with atomic_folder(root / spec.version) as folder:
        for name in [file.name for file in _shard(root, 0).iterdir()]:
            texts = ((_shard(root, i) / name).read_text(encoding="utf-8") for i in range(spec.scenes))
            with naming(folder / name), (folder / name).open("w", encoding="utf-8") as table:
                table.write("[\n")
                for i, text in enumerate(filter(None, texts)):
                    table.write((",\n" if i else "") + text)
                table.write("\n]\n")
        logs = [row["token"] for row in json.loads((folder / "log.json").read_text())]
        for name, rows in fixed_tables(logs).items():
            atomic_write(folder / f"{name}.json", json.dumps(rows, indent=0) + "\n")
        atomic_write(folder / "splits.json", json.dumps(splits(spec.scenes), indent=1) + "\n")


def splits(scenes: int) -> dict[str, list[str]]:
    """Scenes by split: the last fifth, at least one scene, is for validation; a single scene is for training.

    Each split has two names, because the official devkit requires ``train`` and ``val`` to contain its own scenes.

    >>> splits(2)
    {'train': ['scene-0001'], 'synthetic_train': ['scene-0001'],
     'val': ['scene-0002'], 'synthetic_val': ['scene-0002']}
    """
    names = [scene_name(i) for i in range(scenes)]
    last = max(scenes // 5, 1) if scenes > 1 else 0
    named = {"train": names[: scenes - last], "val": names[scenes - last :]}
    return {prefix + split: list(part) for split, part in named.items() if part for prefix in ("", "synthetic_")}
