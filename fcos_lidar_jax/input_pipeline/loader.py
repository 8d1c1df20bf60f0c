"""The training pipeline: batches of raw points whose content is a function of the step alone.

The stream of samples has a global position p: batch ``step`` holds positions step * B to (step + 1) * B - 1.
Position p shows a frame by the shuffled order of its epoch, and draws objects to paste from a generator seeded by
(seed, p). So a batch does not depend on where the run began, on threads or worker processes, or on how many hosts
share it.
"""

import contextlib
import dataclasses
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.cloud_policy import usable_rows
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.input_pipeline.batching import check_boxes, empty_batch, fill_row
from fcos_lidar_jax.input_pipeline.copy_paste import MakePaste, make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.packing import MisfitError, Packing, choose_packing, empty_packed, pack, pack_row
from fcos_lidar_jax.types import Batch, HostBatch
from fcos_lidar_jax.workers import end_with_parent

_MAX_COLUMNS = 6
_CLASS_BALANCE = 0xCB65  # Keeps these draws apart from others of the same seed.
_MAX_THREADS = 16  # Each has a batch in work, which is large.
_INSPECTED = 5  # Frames whose points choose the packing.


class SampleOrder:
    """Which frame every position of the stream of samples shows: epochs of equal length, each shuffled anew.

    Without class balance an epoch is every frame once. With it (CBGS, Zhu et al. 2019), every class is drawn for
    equally often, anew in each epoch: with n_c frames that show class c, N their sum over the classes and C
    classes that occur at all, floor(N / C) frames are drawn for every class, with replacement and equal chances,
    from the n_c. Frames without any box are then never drawn. A position's frame follows from the seed and the
    position alone.

    Raises:
        ValueError: no frames, or none that shows an object.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> plain = dataclasses.replace(QUICKSTART, class_balanced=False)
    >>> order = SampleOrder(SimulatedFrames(TINY, 3), plain, seed=0)
    >>> sorted(order[position] for position in range(order.epoch_size))
    [0, 1, 2]
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
    """Steps until every sample of an epoch was seen; the last batch reaches into the next epoch."""
    return -(-SampleOrder(frames, config, seed=0).epoch_size // config.optimizer.batch_size)


@dataclasses.dataclass(frozen=True)
class _BatchOf:
    """The batch of a step, as a function of the step alone."""

    frames: FrameSet
    config: Config
    seed: int
    order: SampleOrder
    rows: range  # Of the global batch, those of this process.
    fade_step: int  # From which on nothing is pasted.
    paste: MakePaste | None
    packing: Packing | None
    alone: bool  # No other process runs the program.
    misfits: list[str] = dataclasses.field(default_factory=list)  # Found in this process.

    def __call__(self, step: int) -> HostBatch:
        if self.packing is None:
            return self._plain(step)
        # Packing sample by sample is faster, but what does not fit is then prepared again: no more than once.
        plain = self._plain(step) if self.misfits else None
        try:
            if plain is None:
                return self._packed(step, self.packing)
            assert isinstance(plain.batch, Batch)
            return dataclasses.replace(plain, batch=pack(plain.batch, self.packing))
        except MisfitError as error:
            name = self._names(step)[error.row]
            found = f"frame {name!r}: {error}, as in the frames that were looked at first"
        if not self.alone:
            raise ValueError(
                f"{found}; several processes pack all batches alike: use --no-packing, in Python packing=False"
            )
        self.misfits.append(found)
        return dataclasses.replace(plain or self._plain(step), misfit=found)

    def _plain(self, step: int) -> HostBatch:
        batch, counts = empty_batch(len(self.rows), **self._sizes()), Counter[str]()
        for row, position in enumerate(self._positions(step)):
            counts.update(self._fill(batch, row, step, position))
        return HostBatch(batch, dict(counts), self._names(step))

    def _packed(self, step: int, packing: Packing) -> HostBatch:
        batch, counts = empty_packed(len(self.rows), packing, **self._sizes()), Counter[str]()
        # One memory for all samples, which stays in the processor's cache. Of its points only valid rows are read.
        sample: Any = empty_batch(1, **self._sizes())
        for row, position in enumerate(self._positions(step)):
            for array in (sample.valid, sample.boxes, sample.labels, sample.box_valid):
                array[:] = 0
            counts.update(self._fill(sample, 0, step, position))
            pack_row(batch, row, sample)
        return HostBatch(batch, dict(counts), self._names(step))

    def _fill(self, batch: Batch, row: int, step: int, position: int) -> dict[str, int]:
        index, num_pasted = self.order[position], 0
        frame = self.frames.frame(index)
        check_boxes(frame.boxes, self.frames.name(index))
        seen = frame.num_points >= 1
        boxes = {field: getattr(frame, field)[seen] for field in ("boxes", "labels", "num_points")}
        parts, removed = [dataclasses.replace(frame, **boxes)], np.zeros(0, np.int64)
        if self.paste is not None and step < self.fade_step:
            pasted, removed = self.paste(frame, np.random.default_rng([self.seed, position]))
            parts.append(pasted)
            num_pasted = len(pasted.boxes)
        return {"pasted_objects": num_pasted, **fill_row(batch, row, parts, removed)}

    def _sizes(self) -> dict[str, int]:
        columns = self.frames.sensor.point_columns
        return {"max_points": self.config.max_points, "max_boxes": self.config.max_boxes, "columns": columns}

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
    packing: Packing | None = None,
    lend: bool = False,
    order: SampleOrder | None = None,
) -> Iterator[Iterator[HostBatch]]:
    """The batches of a run from some step on, prepared ahead; leaving the context stops all that prepares them.

    A sample is a fused cloud with its boxes of at least one point and the objects pasted into it; augmentation and
    projection are the device's work. Points and boxes beyond the fixed sizes are truncated, and points that no
    sensor measures are removed, both counted, see :func:`fcos_lidar_jax.input_pipeline.batching.fill_row`.

    Args:
        frames: training set, whose labels index ``config.classes``; picklable where there are workers.
        config: batch size, padded sizes, class balance, copy-paste and its end.
        seed: of class balance, order and pasted objects.
        num_steps, first_step: of the whole run, and where a resumed one starts.
        objects: to paste; needed unless ``config.copy_paste`` is None.
        process_index: of this process among those that share each global batch.
        num_processes: process i gets rows i * B / n to (i + 1) * B / n, so the parts in order are the whole.
        threads: that prepare batches, in each worker where there are workers; 0 prepares on demand. Default: see
            :func:`default_threads`. One batch more than there are threads is in work or waits.
        workers: processes that prepare batches; 0 for none.
        packing: by which batches are packed, see :func:`packing_for`; None for plain ones. A batch that does not
            fit comes plain, and a line on standard error says why, once.
        lend: leave batches of workers in the memory through which they came, and save a copy. Keep none of their
            arrays then: they fill memory that the workers need, and must be gone before the process ends.
        order: of the samples, where it is known already.

    Yields:
        an iterator over :class:`fcos_lidar_jax.types.HostBatch`, of this process's rows.

    Raises:
        ValueError: sizes that do not divide, or no frames; :func:`check_loader_options` refuses the rest. From the
            iterator: a frame that cannot be read, or one that does not fit the packing where there are several
            processes, for all of them must run the same program.
    """
    import grain
    from absl import flags

    if not 0 <= first_step <= num_steps:
        raise ValueError(f"first_step: got {first_step}, expected 0 to {num_steps}")
    threads = default_threads(workers) if threads is None else threads
    size = config.optimizer.batch_size
    if not 0 <= process_index < num_processes or size % num_processes:
        raise ValueError(
            f"process {process_index} of {num_processes}: expected a number that divides the batch of {size}"
        )
    order = order or SampleOrder(frames, config, seed=seed)
    batch_of = _BatchOf(
        frames=frames,
        config=config,
        seed=seed,
        order=order,
        rows=range(process_index * size // num_processes, (process_index + 1) * size // num_processes),
        fade_step=num_steps - config.fade_epochs * -(-order.epoch_size // size),
        paste=make_paste(objects, config) if objects is not None and config.copy_paste is not None else None,
        packing=packing,
        alone=num_processes == 1,
    )
    steps = grain.MapDataset.range(first_step, num_steps).map(batch_of)
    # Batches are large: one waits ready beside those in work, no more.
    stream = steps.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=threads + 1))
    if workers:
        if not flags.FLAGS.is_parsed():  # which grain's worker processes read
            flags.FLAGS.mark_as_parsed()
        stream = stream.mp_prefetch(
            grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=1), _leave_signals
        )
    prepared: Any = iter(stream)
    handed_on = _HandedOn(prepared, copied=workers > 0 and not lend)
    with contextlib.closing(prepared), contextlib.closing(handed_on) as batches:
        yield batches


def default_threads(workers: int = 0) -> int:
    """Threads that prepare batches where nobody says how many, in each of ``workers`` processes if there are any.

    In all as many as this process may use cores, less one for the main thread where there are more than two; at
    least 1 and at most 16.

    >>> 1 <= default_threads() <= 16
    True
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    free = cores - 1 if cores > 2 else cores
    return max(min(free, _MAX_THREADS) // max(workers, 1), 1)


def packing_for(frames: FrameSet, config: Config) -> Packing:
    """The packing of a run's batches, from the points of some frames, spread over the set: the first, the last and
    three between. The same frames give the same in every process.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> packing_for(SimulatedFrames(TINY, 3), QUICKSTART).num_lags > 0
    True
    """
    indices = np.unique(np.linspace(0, len(frames) - 1, _INSPECTED).round().astype(int))
    clouds = (frames.frame(int(index)).points for index in indices)
    usable = (points[usable_rows(points)] for points in clouds)
    return choose_packing(usable, num_sweeps=config.num_sweeps, num_pasted=sum(config.paste_targets))


def check_loader_options(
    config: Config,
    objects: GroundTruthDatabase | None,
    *,
    threads: int | None,
    workers: int,
    num_processes: int = 1,
) -> None:
    """Refuse what :func:`make_batches` cannot prepare batches with, before there is a run; arguments as there."""
    for name, value in (("threads", threads), ("workers", workers)):
        if value is not None and value < 0:
            raise ValueError(f"{name}: got {value}, expected at least 0")
    if config.copy_paste is not None and objects is None:
        raise ValueError("copy_paste: got no ground-truth database, expected one, or None in the configuration")
    if workers:
        _check_shared_memory(config, workers, num_processes)


def _leave_signals(worker: int, workers: int) -> None:
    """Ctrl-C and SIGTERM reach all processes of a job: they are the main process's to answer."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()


def _check_shared_memory(config: Config, workers: int, num_processes: int) -> None:
    """A full one would kill the workers without a word; containers often have 64 MiB."""
    row = config.max_points * (4 * _MAX_COLUMNS + 1) + config.max_boxes * 41
    # Each worker has a batch waiting and one in work; one more is on its way out.
    needed = (2 * workers + 1) * row * config.optimizer.batch_size // num_processes
    folder = Path("/dev/shm")
    free = shutil.disk_usage(folder).free if folder.is_dir() else needed
    if free < needed:
        raise ValueError(
            f"workers: got {workers}, for which {folder} has {free >> 20} MiB free, expected {needed >> 20} MiB; "
            f"threads need none"
        )


def _owned(host: HostBatch) -> HostBatch:
    """A batch copied out of the shared memory in which the workers pass it.

    Before it is handed on: grain frees the memory in a thread of its own, in which it needs some time.
    """
    return dataclasses.replace(host, batch=jax.tree.map(np.array, host.batch))


class _HandedOn:
    """Batches that the caller alone keeps, and a line about the first that does not fit the packing.

    No generator, for it is closed while a thread may still be waiting in it for a batch.
    """

    def __init__(self, batches: Iterator[HostBatch], *, copied: bool) -> None:
        self._batches, self._copied = batches, copied
        self._told = False

    def __iter__(self) -> Iterator[HostBatch]:
        return self

    def __next__(self) -> HostBatch:
        host = next(self._batches)
        if host.misfit is not None and not self._told:
            line = f"{host.misfit}: such batches go unpacked, for which the step is compiled once more"
            print(line, file=sys.stderr, flush=True)
            self._told = True
        return _owned(host) if self._copied else host

    def close(self) -> None:
        """Let go of what prepares them; there are none any more."""
        self._batches = iter(())
