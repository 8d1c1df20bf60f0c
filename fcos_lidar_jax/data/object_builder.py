"""Building the object database: cut every object's points out of the frames, a shard at a time."""

import dataclasses
import multiprocessing
import os
import re
import signal
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import msgspec
import numpy as np

from fcos_lidar_jax.data.footprints import points_in_boxes
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.objects import (
    FORMAT,
    MANIFEST,
    ROW,
    VERSION,
    Manifest,
    ObjectDatabase,
    ObjectDatabaseError,
    Shard,
    checksum,
    open_objects,
    points_file,
    read_shard,
    table_file,
)
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.types import CLASSES

ShardPlan = tuple[str, Sequence[int]]
"""A shard's name and the indices of its frames."""


def build_objects(
    frames: FrameSet,
    folder: str | Path,
    *,
    shards: Sequence[ShardPlan],
    fingerprint: str,
    min_points: int = 5,
    workers: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> ObjectDatabase:
    """Cut the points of every box of at least ``min_points`` points out of the frames.

    Each shard is written beside its place and renamed, its table last, so a kill at any moment loses the shards in
    work at most; the next call goes on with the rest. The files are the same bytes whatever the number of workers
    and however often it was stopped. Shards of other data or another plan are replaced.

    Args:
        frames: picklable where there are several workers.
        folder: of the database; made if missing. Nothing else may live there.
        shards: names, fit for file names, and their frames, in the order of the database.
        fingerprint: of the data behind the frames: a shard of an earlier run counts only if it is the same.
        min_points: points, of all sweeps, an object needs.
        workers: processes; 1 works in this one.
        report: called with (frames done, frames in all) at the beginning, frames of an earlier run counted as
            done, and after every shard.

    Returns:
        the finished database, checked and opened.

    Raises:
        ValueError: a shard's name, or frames with different columns.
        OSError: what the file system raises, or a worker that died.
    """
    folder = Path(folder)
    _check_names([name for name, _ in shards])
    if workers < 1:
        raise ValueError(f"workers: got {workers}, expected at least 1")
    folder.mkdir(parents=True, exist_ok=True)
    _sweep(folder, {name for name, _ in shards})
    recipes = [_recipe(fingerprint, min_points, name, indices) for name, indices in shards]
    missing = [i for i, (name, _) in enumerate(shards) if not _finished(folder, name, recipes[i])]
    if missing:  # an old manifest would not fit the new shards
        (folder / MANIFEST).unlink(missing_ok=True)
    jobs = [_Job(folder, shards[i][0], tuple(map(int, shards[i][1])), min_points, recipes[i]) for i in missing]
    total = sum(len(indices) for _, indices in shards)
    done = total - sum(len(job.indices) for job in jobs)
    report = report or (lambda done, total: None)
    report(done, total)
    for count in _inline(frames, jobs) if workers == 1 else _pooled(frames, jobs, workers):
        done += count
        report(done, total)
    _write_manifest(folder, [name for name, _ in shards], fingerprint, min_points)
    return open_objects(folder, fingerprint=fingerprint)


@dataclasses.dataclass(frozen=True)
class _Job:
    folder: Path
    name: str
    indices: tuple[int, ...]
    min_points: int
    recipe: str


def _check_names(names: Sequence[str]) -> None:
    for name in names:
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise ValueError(f"shard name: got {name!r}, expected letters, digits, '_', '-' and '.'")
    if len(set(names)) != len(names):
        raise ValueError(
            f"shard names: got {len(set(names))} different ones of {len(names)}, expected all to differ"
        )


def _recipe(fingerprint: str, min_points: int, name: str, indices: Sequence[int]) -> str:
    """What a shard's bytes follow from."""
    text = repr((FORMAT, VERSION, CLASSES, fingerprint, min_points, name, [int(i) for i in indices]))
    return checksum(text.encode())


def _sweep(folder: Path, names: set[str]) -> None:
    """Remove what a killed run left half-written, and shards that the plan no longer has."""
    for file in folder.iterdir():
        shard = re.sub(r"\.(points\.f32|objects\.npz)$", "", file.name)
        left_over = re.fullmatch(r"\.[0-9a-f]{12}\.(f32|npz|json)", file.name)
        if left_over or (shard != file.name and shard not in names):
            file.unlink()


def _finished(folder: Path, name: str, recipe: str) -> bool:
    """Whether an earlier run left the whole shard, every point of it."""
    try:
        table = read_shard(folder, name)
    except ObjectDatabaseError:
        return False
    if table.recipe != recipe:
        return False
    data, size = memoryview(points_file(folder, name).read_bytes()), 4 * table.columns
    starts, counts = (table.rows[field].tolist() for field in ("start", "count"))
    found = [zlib.crc32(data[size * i : size * (i + n)]) for i, n in zip(starts, counts, strict=True)]
    return found == table.rows["crc32"].tolist()


def _cut_shard(frames: FrameSet, job: _Job) -> int:
    """Write one shard; returns how many frames it has."""
    rows: list[tuple] = []
    parts: list[np.ndarray] = []
    start = columns = 0
    for index in job.indices:
        frame = frames.frame(index)
        if columns not in (0, frame.points.shape[1]):
            raise ValueError(f"frame {index}: points: got {frame.points.shape[1]} columns, expected {columns}")
        columns = frame.points.shape[1]
        found = points_in_boxes(frame.points, frame.boxes)
        for box, label, inside in zip(frame.boxes, frame.labels, found, strict=True):
            if len(inside) < job.min_points:
                continue
            points = np.ascontiguousarray(frame.points[inside], "<f4")
            current = np.count_nonzero(points[:, 4] == 0)
            rows.append((box, label, index, start, len(points), current, zlib.crc32(points.data)))
            parts.append(points)
            start += len(points)
    table = {"rows": np.array(rows, ROW), "columns": np.int32(columns), "recipe": np.array(job.recipe)}
    points = np.concatenate(parts) if parts else np.zeros((0, columns), "<f4")
    write_beside(points_file(job.folder, job.name), lambda path: points.tofile(path))
    write_beside(table_file(job.folder, job.name), lambda path: np.savez(path, allow_pickle=False, **table))
    return len(job.indices)


def _inline(frames: FrameSet, jobs: Sequence[_Job]) -> Iterator[int]:
    for job in jobs:
        yield _cut_shard(frames, job)


def _pooled(frames: FrameSet, jobs: Sequence[_Job], workers: int) -> Iterator[int]:
    pool = ProcessPoolExecutor(
        min(workers, max(len(jobs), 1)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_worker,
        initargs=(frames,),
    )
    try:
        # The workers inherit the mask: an interruption is this process's to answer.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            futures = [pool.submit(_work, job) for job in jobs]
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool:
        raise OSError("a worker died, perhaps for want of memory: try fewer workers") from None
    finally:  # after an interruption too: the shards in work are finished, no other is begun
        pool.shutdown(wait=True, cancel_futures=True)


_worker_frames: FrameSet | None = None


def _begin_worker(frames: FrameSet) -> None:
    global _worker_frames
    _worker_frames = frames
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:  # which may be killed
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


def _work(job: _Job) -> int:
    assert _worker_frames is not None
    return _cut_shard(_worker_frames, job)


def _write_manifest(folder: Path, names: Sequence[str], fingerprint: str, min_points: int) -> None:
    entries, columns = [], 0
    for name in names:
        table = read_shard(folder, name)
        if columns and table.columns not in (0, columns):
            raise ValueError(f"shard {name!r}: points: got {table.columns} columns, expected {columns}")
        columns = columns or table.columns
        entries.append(Shard(name, len(table.rows), table.num_points, table.blake2b))
    manifest = Manifest(FORMAT, VERSION, fingerprint, list(CLASSES), min_points, columns, entries)
    text = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
    write_beside(folder / MANIFEST, lambda path: path.write_bytes(text))
