"""Resumable export of a synthetic data set: first the scenes, then the tables.

``OUT/.synthesize`` contains the specification of the data set and the rows of finished scenes. The folder of
tables appears in one step when all scenes are finished.
"""

import contextlib
import dataclasses
import itertools
import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import atomic_write, file_checksum, folder_lock, naming, read_json
from fcos_lidar_jax.simulation.nuscenes_tables import CHANNEL, MAP_FILE, fixed_tables, scene_name, sweep_file
from fcos_lidar_jax.simulation.render import DatasetSpec, render_scene
from fcos_lidar_jax.workers import end_with_parent

_WORK = ".synthesize"
_ORDER, _TABLES = f"{_WORK}/order.json", f"{_WORK}/tables.json"  # checksums of the tables
_FORMAT = 2  # increases when the bytes of the same specification change
_POLL_S = 0.5


def write_dataset(spec: DatasetSpec, root: Path, *, workers: int, report: Callable[[int], object]) -> bool:
    """Write a data set in the official layout, or resume an unfinished one; False if it was already complete.

    The folder is new, empty, or has an unfinished data set of the same specification; others are refused. The
    bytes do not depend on the number of worker processes. ``report`` gets the number of finished sweeps.
    """
    _check_order(spec, root)  # reject before writing anything
    if _finished(spec, root) and not _shards(spec, root):
        return False
    with folder_lock(root / _WORK, "synthesizing"):
        order = _check_order(spec, root)
        finished = _finished(spec, root)  # by another process meanwhile, or killed while it removed the shards
        if not finished:
            atomic_write(root / _ORDER, lambda path: _write_text(path, json.dumps(order, indent=1) + "\n"))
            _write_rest(spec, root, workers, report)
        for shard in _shards(spec, root):
            shutil.rmtree(shard, ignore_errors=True)
    return not finished


def _write_rest(spec: DatasetSpec, root: Path, workers: int, report: Callable[[int], object]) -> None:
    for folder in ("samples", "sweeps"):
        (root / folder / CHANNEL).mkdir(parents=True, exist_ok=True)
    todo = [index for index in range(spec.scenes) if not _shard(root, index).is_dir()]
    before = (spec.scenes - len(todo)) * spec.sweeps
    if workers == 1 or len(todo) <= 1:
        done = itertools.count(before + 1)
        for index in todo:
            _write_scene(spec, root, index, lambda: report(next(done)))
    else:
        _write_in_processes(spec, root, todo, workers, lambda done: report(before + done))
    _write_tables(spec, root)


def _check_order(spec: DatasetSpec, root: Path) -> dict[str, Any]:
    """Specification of the data set as JSON; rejects a folder with other contents."""
    order = {"format": _FORMAT, **dataclasses.asdict(spec)}
    del order["sensor"]["forward_rad"]  # changes no file
    if root.exists() and not root.is_dir():
        raise ValueError(f"{root}: found a file, expected a folder")
    file = root / _ORDER
    if not file.is_file():
        if root.is_dir() and any(p.name != _WORK for p in root.iterdir()):
            raise ValueError(f"{root}: found other files, expected an empty folder or a data set of this command")
        return order
    own, begun = _by_field(json.loads(json.dumps(order))), _by_field(read_json(file, dict[str, Any]))
    for name in own | begun:
        value, before = own.get(name), begun.get(name)
        if before != value:
            raise ValueError(f"{root}: {name}: got {value}, expected {before} as in the data set begun there")
    return order


def _by_field(order: dict[str, Any]) -> dict[str, Any]:
    """Values by path; the name of the sensor or of the streets comes first and stands for the whole."""
    found = {}
    for name, value in order.items():
        fields = dict(value) if isinstance(value, dict) else {"name": value}
        found[name] = fields.pop("name", None)
        found |= {f"{name}.{field}": v for field, v in fields.items()}
    return found


def _finished(spec: DatasetSpec, root: Path) -> bool:
    """Whether the data set is complete; rejects a data set with files that are missing or changed since."""
    folder = root / spec.version
    if not folder.is_dir():
        return False
    written = read_json(root / _TABLES, dict[str, str]) if (root / _TABLES).is_file() else {}
    size = spec.sensor.num_rows * spec.sensor.num_columns * 5 * 4
    clouds = itertools.product(range(spec.scenes), range(spec.sweeps))
    files = (root / sweep_file(spec.seed, index, number) for index, number in clouds)
    tables = ((folder / name, checksum) for name, checksum in written.items())
    # Names of tables are read from a file: ``Path.is_file`` raises an OSError where one is too long.
    damaged = itertools.chain(
        (file for file in files if not file.is_file() or file.stat().st_size != size),
        (file for file, checksum in tables if not os.path.isfile(file) or file_checksum(file) != checksum),
    )
    if (file := next(damaged, None)) is not None:
        found = "other content" if os.path.isfile(file) else "nothing"
        raise ValueError(f"{file}: found {found}, expected the file as written: remove {root} and run again")
    return True


def _shard(root: Path, index: int) -> Path:
    return root / _WORK / scene_name(index)


def _shards(spec: DatasetSpec, root: Path) -> list[Path]:
    return [shard for index in range(spec.scenes) if (shard := _shard(root, index)).is_dir()]


@contextlib.contextmanager
def _new_folder(folder: Path, root: Path) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to ``folder`` on success."""
    unfinished = root / _WORK / f"{folder.name}.part"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    yield unfinished
    os.replace(unfinished, folder)


def _write_text(path: Path, text: str) -> None:
    with naming(path):
        path.write_text(text, encoding="utf-8")


def _write_scene(spec: DatasetSpec, root: Path, index: int, advance: Callable[[], object]) -> None:
    rows = render_scene(spec, index, root, advance)
    with _new_folder(_shard(root, index), root) as folder:
        for name, table in rows.items():  # the text of the final table without its brackets
            _write_text(folder / f"{name}.json", json.dumps(table, indent=0)[1:-1].strip("\n"))


def _write_in_processes(
    spec: DatasetSpec, root: Path, todo: list[int], workers: int, report: Callable[[int], object]
) -> None:
    """Write scenes in worker processes, which end when this process ends."""
    context = multiprocessing.get_context("spawn")
    counter, others = context.Value("q", 0), set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(min(workers, len(todo)), context, initializer=_begin_worker, initargs=(counter,))
    with pool:
        pending = {pool.submit(_write_scene, spec, root, index, _advance) for index in todo}
        try:
            while pending:
                finished, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                for future in finished:
                    future.result()
                report(counter.value)
        except BrokenProcessPool:
            raise OSError("a worker process died, possibly out of memory: try fewer workers") from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


_counter: Any = None  # in worker processes, number of sweeps finished by all workers


def _advance() -> None:
    with _counter.get_lock():
        _counter.value += 1


def _begin_worker(counter: Any) -> None:
    global _counter
    _counter = counter
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interruptions
    end_with_parent()


def _write_tables(spec: DatasetSpec, root: Path) -> None:
    """Write all tables from the rows of the scenes, one scene in memory at a time."""
    with _new_folder(root / spec.version, root) as folder:
        for name in [file.name for file in _shard(root, 0).iterdir()]:
            texts = ((_shard(root, i) / name).read_text(encoding="utf-8") for i in range(spec.scenes))
            with naming(folder / name), (folder / name).open("w", encoding="utf-8") as table:
                table.write("[\n")
                for i, text in enumerate(filter(None, texts)):
                    table.write((",\n" if i else "") + text)
                table.write("\n]\n")
        logs = [row["token"] for row in json.loads((folder / "log.json").read_text())]
        for name, rows in fixed_tables(logs).items():
            _write_text(folder / f"{name}.json", json.dumps(rows, indent=0) + "\n")
        _write_text(folder / "splits.json", json.dumps(splits(spec.scenes), indent=1) + "\n")
        written = {file.name: file_checksum(file) for file in sorted(folder.iterdir())}
        atomic_write(root / _TABLES, lambda path: _write_text(path, json.dumps(written, indent=1) + "\n"))
        (root / MAP_FILE).parent.mkdir(exist_ok=True)
        _write_text(root / MAP_FILE, "")


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
