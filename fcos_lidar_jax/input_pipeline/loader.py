"""The training pipeline: batches of raw points whose content is a function of the step alone.

The stream of samples has a global position p: batch ``step`` holds positions step * B to (step + 1) * B - 1.
Position p shows a frame by the shuffled order of its epoch, and draws objects to paste from a generator seeded by
(seed, p). So a batch does not depend on where the run began, on threads or worker processes, or on how many hosts
share it.
"""

import contextlib
import dataclasses
import shutil
import signal
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.input_pipeline.batching import check_boxes, empty_batch, fill_row
from fcos_lidar_jax.input_pipeline.copy_paste import make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase
from fcos_lidar_jax.types import HostBatch
from fcos_lidar_jax.workers import end_with_parent

_MAX_COLUMNS = 6
_CLASS_BALANCE = 0xCB65  # Keeps these draws apart from others of the same seed.


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
    threads: int = 2,
    workers: int = 0,
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
        threads: that prepare batches, in each worker where there are workers; 0 prepares on demand.
        workers: processes that prepare batches; 0 for none.

    Yields:
        an iterator over :class:`fcos_lidar_jax.types.HostBatch`, of this process's rows.

    Raises:
        ValueError: sizes that do not divide, no frames, or no objects where some are to be pasted.
    """
    import grain
    from absl import flags

    if not 0 <= first_step <= num_steps:
        raise ValueError(f"first_step: got {first_step}, expected 0 to {num_steps}")
    check_loader_options(config, objects, threads=threads, workers=workers, num_processes=num_processes)
    size = config.optimizer.batch_size
    if not 0 <= process_index < num_processes or size % num_processes:
        raise ValueError(
            f"process {process_index} of {num_processes}: expected a number that divides the batch of {size}"
        )
    order = SampleOrder(frames, config, seed=seed)
    rows = range(process_index * size // num_processes, (process_index + 1) * size // num_processes)
    fade_step = num_steps - config.fade_epochs * -(-order.epoch_size // size)
    paste = make_paste(objects, config) if objects is not None and config.copy_paste is not None else None

    def batch_of(step: int) -> HostBatch:
        positions = [step * size + row for row in rows]
        shown = [order[position] for position in positions]
        names = tuple(frames.name(index) for index in shown)
        counts, columns = Counter(pasted_objects=0), frames.sensor.point_columns
        batch = empty_batch(len(shown), max_points=config.max_points, max_boxes=config.max_boxes, columns=columns)
        for row, (position, index) in enumerate(zip(positions, shown, strict=True)):
            frame = frames.frame(index)
            check_boxes(frame.boxes, names[row])
            seen = frame.num_points >= 1
            boxes = {field: getattr(frame, field)[seen] for field in ("boxes", "labels", "num_points")}
            parts, removed = [dataclasses.replace(frame, **boxes)], np.zeros(0, np.int64)
            if paste is not None and step < fade_step:
                pasted, removed = paste(frame, np.random.default_rng([seed, position]))
                parts.append(pasted)
                counts["pasted_objects"] += len(pasted.boxes)
            counts.update(fill_row(batch, row, parts, removed))
        return HostBatch(batch, dict(counts), names)

    steps = grain.MapDataset.range(first_step, num_steps).map(batch_of)
    # Batches are large: one waits ready beside those in work, no more.
    stream = steps.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=threads + 1))
    if workers:
        if not flags.FLAGS.is_parsed():  # which grain's worker processes read
            flags.FLAGS.mark_as_parsed()
        stream = stream.mp_prefetch(
            grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=1), _leave_signals
        )
    prepared: Any = _from_workers(stream) if workers else iter(stream)
    with contextlib.closing(prepared) as batches:
        yield batches


def check_loader_options(
    config: Config, objects: GroundTruthDatabase | None, *, threads: int, workers: int, num_processes: int = 1
) -> None:
    """Refuse what :func:`make_batches` cannot prepare batches with, before there is a run; arguments as there."""
    for name, value in (("threads", threads), ("workers", workers)):
        if value < 0:
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


def _from_workers(stream: Iterable[HostBatch]) -> Iterator[HostBatch]:
    """Batches out of the shared memory in which the workers pass them."""
    iterator: Any = iter(stream)
    with contextlib.closing(iterator):
        for item in iterator:
            batch = dataclasses.replace(item, batch=jax.tree.map(np.array, item.batch))
            # Before it is handed on: grain frees the memory in a thread of its own, in which it needs some time.
            del item
            yield batch
