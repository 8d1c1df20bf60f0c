"""A synthetic data set on disk: scenes one by one, tables last, resumable at any moment.

While it is being made, ``OUT/.synthesize`` holds the order and the rows of the scenes that are done. The tables
appear at once, when all scenes are there.
"""

import dataclasses
import json
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.simulation.nuscenes_tables import (
    CHANNEL,
    MAP_FILE,
    SCENE_TABLES,
    Row,
    fixed_tables,
    map_table,
)
from fcos_lidar_jax.simulation.render import SWEEPS_PER_KEYFRAME, DatasetSpec, render_scene, scene_name

_WORK = ".synthesize"
_ORDER = "order.json"
_FORMAT = 1
"""Rises when the same order gives other bytes."""
_POLL_S = 0.5


class DatasetSpecError(ValueError):
    """The folder cannot take this data set; one line that says why."""


def write_dataset(order: DatasetSpec, root: Path, *, workers: int, report: Callable[[int], object]) -> bool:
    """Write a data set in the official layout, or go on with one that was begun.

    Args:
        order: what to write.
        root: the data set's folder: new, empty, or one where the same order was begun.
        workers: processes; the bytes do not depend on it.
        report: called with the number of sweeps that are done, now and then.

    Returns:
        False where everything was there already.

    Raises:
        DatasetSpecError: the folder holds something else.
        OSError: what cannot be written.
    """
    _claim(order, root)
    tables = root / order.version
    if tables.is_dir():
        return False
    for folder in ("samples", "sweeps"):
        (root / folder / CHANNEL).mkdir(parents=True, exist_ok=True)
    todo = [i for i in range(order.scenes) if not _shard(root, i).is_dir()]
    per_scene = (order.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1
    before = (order.scenes - len(todo)) * per_scene
    if workers == 1 or len(todo) <= 1:
        _write_here(order, root, todo, lambda done: report(before + done))
    else:
        _write_in_processes(order, root, todo, workers, lambda done: report(before + done))
    _write_tables(order, root)
    return True


def _claim(order: DatasetSpec, root: Path) -> None:
    """Make the folder this order's, or check that it is."""
    wanted = {"format": _FORMAT, **dataclasses.asdict(order), "sensor": sensor_to_json(order.sensor)}
    wanted = json.loads(json.dumps(wanted))
    if root.exists() and not root.is_dir():
        raise DatasetSpecError(f"{root}: found a file, expected a folder")
    file = root / _WORK / _ORDER
    if not file.is_file():
        if root.is_dir() and any(p.name != _WORK for p in root.iterdir()):
            raise DatasetSpecError(f"{root}: not empty, and not begun by this command: expected a new folder")
        atomic_write(file, lambda p: _write_text(p, json.dumps(wanted, indent=1) + "\n"))
        return
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        raise DatasetSpecError(f"{file}: not JSON, expected what this folder was begun with") from None
    if not isinstance(found, dict):
        raise DatasetSpecError(f"{file}: got {type(found).__name__}, expected a JSON object")
    for name, value in wanted.items():
        if found.get(name) != value:
            got, expected = (v["name"] if name == "sensor" and v else v for v in (value, found.get(name)))
            raise DatasetSpecError(f"{root}: {name}: got {got}, but the data set there was begun with {expected}")


def _shard(root: Path, index: int) -> Path:
    return root / _WORK / scene_name(index)


def _write_scene(order: DatasetSpec, root: Path, index: int, advance: Callable[[int], object]) -> None:
    rows = render_scene(order, index, root, advance)
    shard = _shard(root, index)
    unfinished = shard.with_suffix(".part")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    for name in SCENE_TABLES:
        _write_text(unfinished / f"{name}.json", _rows_text(rows[name]))
    os.replace(unfinished, shard)


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def _rows_text(rows: list[Row]) -> str:
    """Rows as a table holds them, without the brackets around."""
    return json.dumps(rows, indent=0)[1:-1].strip("\n")


def _write_here(order: DatasetSpec, root: Path, todo: list[int], report: Callable[[int], object]) -> None:
    done = 0

    def advance(sweeps: int) -> None:
        nonlocal done
        done += sweeps
        report(done)

    for index in todo:
        _write_scene(order, root, index, advance)


def _write_in_processes(
    order: DatasetSpec, root: Path, todo: list[int], workers: int, report: Callable[[int], object]
) -> None:
    """Scenes in processes of their own; whatever ends this one ends them."""
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(
        min(workers, len(todo)), mp_context=context, initializer=_begin_worker, initargs=(counter,)
    ) as pool:
        pending = {pool.submit(_work, order, root, index) for index in todo}
        try:
            while pending:
                finished, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                for future in finished:
                    future.result()
                report(counter.value)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


_counter: Any = None
"""In a worker process: the sweeps that all of them have done."""


def _begin_worker(counter: Any) -> None:
    global _counter
    _counter = counter
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interruption is the parent's affair
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _work(order: DatasetSpec, root: Path, index: int) -> None:
    def advance(sweeps: int) -> None:
        with _counter.get_lock():
            _counter.value += sweeps

    _write_scene(order, root, index, advance)


def _write_tables(order: DatasetSpec, root: Path) -> None:
    """All tables into a folder beside, which then takes its name."""
    unfinished = root / _WORK / "tables.part"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    for name in SCENE_TABLES:
        _join(unfinished / f"{name}.json", [_shard(root, i) / f"{name}.json" for i in range(order.scenes)])
    logs = [row["token"] for row in json.loads((unfinished / "log.json").read_text())]
    for name, rows in {**fixed_tables(), "map": map_table(logs)}.items():
        _write_text(unfinished / f"{name}.json", json.dumps(rows, indent=0) + "\n")
    _write_text(unfinished / "splits.json", json.dumps(splits(order.scenes), indent=1) + "\n")
    picture = root / MAP_FILE
    picture.parent.mkdir(exist_ok=True)
    _write_text(picture, "")
    os.replace(unfinished, root / order.version)
    for index in range(order.scenes):
        shutil.rmtree(_shard(root, index), ignore_errors=True)


def _join(path: Path, parts: list[Path]) -> None:
    """One table from the scenes' rows; never all of them in memory."""
    try:
        with path.open("w", encoding="utf-8") as table:
            table.write("[\n")
            between = ""
            for part in parts:
                text = part.read_text(encoding="utf-8")
                if text:
                    table.write(between + text)
                    between = ",\n"
            table.write("\n]\n")
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def splits(scenes: int) -> dict[str, list[str]]:
    """Split name -> scenes: the last fifth, at least one, is for validation; a single scene is for training.

    Each split has two names, since the official devkit wants ``train`` and ``val`` to be its own scenes.

    >>> splits(2)
    {'train': ['scene-0001'], 'synthetic_train': ['scene-0001'],
     'val': ['scene-0002'], 'synthetic_val': ['scene-0002']}
    """
    names = [scene_name(i) for i in range(scenes)]
    last = max(scenes // 5, 1) if scenes > 1 else 0
    named = {"train": names[: scenes - last], "val": names[scenes - last :]}
    return {prefix + split: list(part) for split, part in named.items() if part for prefix in ("", "synthetic_")}
