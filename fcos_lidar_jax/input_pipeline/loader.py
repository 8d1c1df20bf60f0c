"""The training pipeline: batches of raw points that depend only on the step.

Batch ``step`` contains the positions step * B to (step + 1) * B - 1 of the stream of samples. Position p takes its
frame from the shuffled order of its epoch, and pasted objects from a generator seeded by (seed, p). A batch is
therefore independent of the run's first step, threads, worker processes, and the number of hosts that share it.
"""

import contextlib
import dataclasses
import os
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.box_geometry import check_boxes
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.input_pipeline.batching import empty_batch, fill_row
from fcos_lidar_jax.input_pipeline.copy_paste import Paste, make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.types import Batch, HostBatch
from fcos_lidar_jax.workers import end_with_parent

_MAX_COLUMNS = 6
_CLASS_BALANCE = 0xCB65  # separates these random numbers from others of the same seed
_MAX_THREADS = 16  # each holds a large batch


class SampleOrder:
    """The frame of every position in the stream of samples: epochs of equal length, each shuffled anew.

    Without class balance an epoch contains every frame once. With class balance (CBGS, Zhu et al. 2019) an epoch
    samples equally often for each class: with n_c frames that show class c, N the sum of n_c and C the number of
    classes that occur, it samples floor(N / C) frames per class, uniformly and with replacement from the n_c.
    Frames without boxes are then never sampled. A position's frame depends only on the seed and the position.
    """

    def __init__(self, frames: FrameSet, config: Config, *, seed: int) -> None:
        import grain

        if not len(frames):
            raise ValueError("training frames: got none, expected at least one")
        self.seed, self.epoch_size, self._share = seed, len(frames), 0
        self._showing: list[np.ndarray] = []
        if config.class_balanced:
            shows = np.zeros((len(frames), len(config.classes)), bool)
            for index in range(len(frames)):
                shows[index, frames.labels(index)] = True
            self._showing = [np.flatnonzero(shown) for shown in shows.T if shown.any()]
            if not self._showing:
                raise ValueError(f"class balance: none of the {len(frames)} frames shows an object")
            self._share = int(shows.sum()) // len(self._showing)
            self.epoch_size = self._share * len(self._showing)
        # grain adds the epoch to its seed: seeds far apart keep two runs from sharing orders.
        shuffle_seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        self._shuffled: Any = grain.MapDataset.range(self.epoch_size).shuffle(seed=shuffle_seed).repeat()

    def __getitem__(self, position: int) -> int:
        index = int(self._shuffled[position])
        if not self._showing:
            return index
        draw = np.random.default_rng([self.seed, _CLASS_BALANCE, position // self.epoch_size, index])
        return int(draw.choice(self._showing[index // self._share]))


def steps_per_epoch(frames: FrameSet, config: Config) -> int:
    """Steps per epoch, rounded up: the last batch reaches into the next epoch."""
    return -(-SampleOrder(frames, config, seed=0).epoch_size // config.optimizer.batch_size)


@dataclasses.dataclass(frozen=True)
class _BatchOf:
    frames: FrameSet
    config: Config
    seed: int
    order: SampleOrder
    rows: range  # this process's rows of the global batch
    fade_step: int  # first step without pasted objects
    paste: Paste | None

    def __call__(self, step: int) -> HostBatch:
        config, columns = self.config, self.frames.sensor.point_columns
        sizes = {"max_points": config.max_points, "max_boxes": config.max_boxes, "columns": columns}
        batch, counts = empty_batch(len(self.rows), **sizes), Counter[str]()
        for row, position in enumerate(self._positions(step)):
            counts.update(self._fill(batch, row, step, position))
        return HostBatch(batch, dict(counts), self._names(step))

    def _fill(self, batch: Batch, row: int, step: int, position: int) -> dict[str, int]:
        index, num_pasted = self.order[position], 0
        frame = self.frames.frame(index)
        check_boxes(frame.boxes, lambda box: f"frame {self.frames.name(index)!r}: box {box}")
        seen = frame.num_points != 0
        boxes = {field: getattr(frame, field)[seen] for field in ("boxes", "labels", "num_points")}
        parts, removed = [dataclasses.replace(frame, **boxes)], np.zeros(0, np.int64)
        if self.paste is not None and step < self.fade_step:
            pasted, removed = self.paste(frame, np.random.default_rng([self.seed, position]))
            parts.append(pasted)
            num_pasted = len(pasted.boxes)
        return {"pasted_objects": num_pasted, **fill_row(batch, row, parts, removed)}

    def _positions(self, step: int) -> list[int]:
        return [step * self.config.optimizer.batch_size + row for row in self.rows]

    def _names(self, step: int) -> tuple[str, ...]:
        return tuple(self.frames.name(self.order[position]) for position in self._positions(step))


@contextlib.contextmanager
def make_batches(
    frames: FrameSet,
    config: Config,
    *,
    seed: int,
    num_steps: int,
    first_step: int = 0,
    objects: GroundTruthDatabase | None = None,
    process_index: int = 0,
    num_processes: int = 1,
    threads: int | None = None,
    workers: int = 0,
    order: SampleOrder | None = None,
) -> Iterator[Iterator[HostBatch]]:
    """Context manager that yields a run's batches, prepared ahead; leaving it stops threads and workers.

    A sample is a fused cloud with its boxes of at least one point, and pasted objects; the device augments and
    projects. Points and boxes beyond the fixed sizes are truncated, invalid points removed, and both counted, see
    :func:`fcos_lidar_jax.input_pipeline.batching.fill_row`.

    Args:
        frames: training set with labels that index ``config.classes``; must be picklable for workers.
        objects: database for copy-paste; required unless ``config.copy_paste`` is None.
        num_processes: of n processes, process i gets the rows i * B / n to (i + 1) * B / n of each batch.
        threads: threads per process that prepare batches, 0 to prepare on demand; default: see
            :func:`default_threads`. At most one batch more than threads is in progress or waiting.
        workers: processes that prepare batches, 0 for threads of this process. Do not keep the arrays of their
            batches: they lie in shared memory, which must be released before the process ends.

    Yields:
        an iterator over :class:`fcos_lidar_jax.types.HostBatch` with this process's rows; it raises the errors of
        unreadable frames.
    """
    threads = default_threads(workers) if threads is None else threads
    size = config.optimizer.batch_size
    order = order or SampleOrder(frames, config, seed=seed)
    batch_of = _BatchOf(
        frames=frames,
        config=config,
        seed=seed,
        order=order,
        rows=range(process_index * size // num_processes, (process_index + 1) * size // num_processes),
        fade_step=num_steps - config.fade_epochs * -(-order.epoch_size // size),
        paste=make_paste(objects, config) if objects is not None and config.copy_paste is not None else None,
    )
    prepared = _prepared(batch_of, first_step, num_steps, threads, workers)
    with contextlib.closing(prepared), contextlib.closing(_LetGo(prepared)) as batches:
        yield batches


def _prepared(batch_of: _BatchOf, first_step: int, num_steps: int, threads: int, workers: int) -> Any:
    """Grain's iterator over the batches, prepared ahead by threads, in this process or in workers."""
    import grain
    from absl import flags

    steps = grain.MapDataset.range(first_step, num_steps).map(batch_of)
    # Batches are large, so that only one waits beside the batches in progress.
    stream = steps.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=threads + 1))
    if workers:
        if not flags.FLAGS.is_parsed():  # read by grain's worker processes
            flags.FLAGS.mark_as_parsed()
        stream = stream.mp_prefetch(
            grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=1), _leave_signals
        )
    return iter(stream)


def default_threads(workers: int = 0) -> int:
    """Default number of threads per process that prepare batches.

    All processes together get as many threads as this process may use cores, minus one for the main thread if
    there are more than two; at least 1 each and at most 16.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    free = cores - 1 if cores > 2 else cores
    return max(min(free, _MAX_THREADS) // max(workers, 1), 1)


def check_loader_options(config: Config, *, threads: int | None, workers: int, num_processes: int = 1) -> None:
    """Check the options of :func:`make_batches` before a run begins."""
    for name, value in (("threads", threads), ("workers", workers)):
        check(value is None or value >= 0, name, value, "at least 0")
    _ = config.paste_targets  # refuses
    if workers:
        _check_shared_memory(config, workers, num_processes)


def _leave_signals(worker: int, workers: int) -> None:
    """Ignore Ctrl-C and SIGTERM, which reach all processes of a job: the main process answers them."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()


def _check_shared_memory(config: Config, workers: int, num_processes: int) -> None:
    """Refuse too little shared memory, which would kill workers silently; containers often have 64 MiB."""
    row = config.max_points * (4 * _MAX_COLUMNS + 1) + config.max_boxes * 41
    # Each worker has one batch waiting and one in progress; one more is being transferred.
    needed = (2 * workers + 1) * row * config.optimizer.batch_size // num_processes
    folder = Path("/dev/shm")
    free = shutil.disk_usage(folder).free if folder.is_dir() else needed
    if free < needed:
        raise ValueError(
            f"workers: got {workers}, for which {folder} has {free >> 20} MiB free, expected {needed >> 20} MiB; "
            f"threads need no shared memory"
        )


class _LetGo:
    """An iterator that lets go of grain's when it is closed, because grain's complains if it lives until the exit.

    Not a generator, because it is closed while a thread may still be waiting in it for a batch.
    """

    def __init__(self, batches: Iterator[HostBatch]) -> None:
        self._batches = batches

    def __iter__(self) -> Iterator[HostBatch]:
        return self

    def __next__(self) -> HostBatch:
        return next(self._batches)

    def close(self) -> None:
        self._batches = iter(())
