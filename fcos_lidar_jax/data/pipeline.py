"""The training pipeline: batches of raw points whose content is a function of the step alone.

The stream of samples has a global position p: batch ``step`` holds positions step * B to (step + 1) * B - 1.
Position p shows a frame by the shuffled order of its epoch, and draws objects to paste from a generator seeded by
(seed, p). So a batch does not depend on where the run began, on threads or worker processes, or on how many hosts
share it.
"""

import contextlib
import dataclasses
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.batching import empty_batch, fill_boxes, fill_points
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.data.objects import ObjectDatabase
from fcos_lidar_jax.data.pasting import Paste, make_paste
from fcos_lidar_jax.data.resampling import class_balanced_frames
from fcos_lidar_jax.types import Batch

_MOST_COLUMNS = 6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HostBatch:
    """A batch on its way to the device, with what is to be logged about it."""

    batch: Batch
    """NumPy arrays of this process's rows."""
    step: int
    """Which update it is for."""
    counts: dict[str, int]
    """``overflow_points`` and ``overflow_boxes`` that found no room, ``pasted_objects``."""
    names: tuple[str, ...]
    """Of the samples' frames, for messages."""


def epoch_frames(frames: FrameSet, config: Config, *, seed: int) -> np.ndarray:
    """The frames of an epoch before it is shuffled, i64[s]: all of them once, or class-balanced.

    Args:
        frames: training set.
        config: ``class_balanced``.
        seed: of the resampling.
    """
    if not config.class_balanced:
        return np.arange(len(frames))
    return class_balanced_frames([frames.labels(i) for i in range(len(frames))], seed=seed)


def steps_per_epoch(num_samples: int, batch_size: int) -> int:
    """Steps until every sample of an epoch was seen; the last batch reaches into the next epoch.

    >>> steps_per_epoch(10, 4)
    3
    """
    return -(-num_samples // batch_size)


@contextlib.contextmanager
def make_batches(
    frames: FrameSet,
    config: Config,
    *,
    seed: int,
    num_steps: int,
    first_step: int = 0,
    objects: ObjectDatabase | None = None,
    process_index: int = 0,
    num_processes: int = 1,
    threads: int = 2,
    workers: int = 0,
) -> Iterator[Iterator[HostBatch]]:
    """The batches of a run from some step on, prepared ahead; leaving the context stops all that prepares them.

    A sample is a fused cloud with its boxes of at least one point and the objects pasted into it; augmentation and
    projection are the device's work. Where the fixed sizes do not suffice, the oldest sweeps lose points and the
    boxes with the fewest points go, counted.

    Args:
        frames: training set; picklable where there are workers.
        config: batch size, padded sizes, resampling, copy-paste and its end.
        seed: of resampling, order and pasted objects.
        num_steps: of the whole run.
        first_step: where a resumed run goes on.
        objects: to paste; needed unless ``config.copy_paste`` is None.
        process_index: of this process among those that share each global batch.
        num_processes: process i gets rows i * B / n to (i + 1) * B / n, so the parts in order are the whole.
        threads: that prepare batches, in each worker where there are workers; 0 prepares on demand.
        workers: processes that prepare batches; 0 for none.

    Yields:
        an iterator over :class:`HostBatch`.

    Raises:
        ValueError: sizes that do not divide, no frames, or no objects where some are to be pasted.
    """
    import grain

    if not 0 <= first_step <= num_steps:
        raise ValueError(f"first_step: got {first_step}, expected 0 to {num_steps}")
    for name, value in (("threads", threads), ("workers", workers)):
        if value < 0:
            raise ValueError(f"{name}: got {value}, expected at least 0")
    recipe = _Recipe(frames, config, seed, num_steps, objects, process_index, num_processes)
    steps = grain.MapDataset.range(first_step, num_steps).map(recipe)
    # Batches are large: one waits ready beside those in work, no more.
    stream = steps.to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=threads + 1))
    if workers:
        _check_shared_memory(config, workers, num_processes)
        _mark_flags_parsed()
        stream = stream.mp_prefetch(grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=1))
    prepared: Any = _from_workers(stream) if workers else iter(stream)
    with contextlib.closing(prepared) as batches:
        yield batches


def _check_shared_memory(config: Config, workers: int, num_processes: int) -> None:
    """A full one would kill the workers without a word; containers often have 64 MiB."""
    row = config.max_points * (4 * _MOST_COLUMNS + 1) + config.max_boxes * 41
    # Each worker has a batch waiting and one in work; one more is on its way out.
    needed = (2 * workers + 1) * row * config.optimizer.batch_size // num_processes
    folder = Path("/dev/shm")
    free = shutil.disk_usage(folder).free if folder.is_dir() else needed
    if free < needed:
        raise ValueError(
            f"workers: got {workers}, for which {folder} has {free >> 20} MiB free, expected {needed >> 20} MiB; "
            f"threads need none"
        )


def _mark_flags_parsed() -> None:
    """Worker processes of grain read absl's flags, which nobody parses here."""
    from absl import flags

    if not flags.FLAGS.is_parsed():
        flags.FLAGS.mark_as_parsed()


def _from_workers(stream: Iterable[HostBatch]) -> Iterator[HostBatch]:
    """Batches out of the shared memory in which the workers pass them."""
    iterator: Any = iter(stream)
    with contextlib.closing(iterator):
        for item in iterator:
            batch = dataclasses.replace(item, batch=jax.tree.map(np.array, item.batch))
            # Before it is handed on: grain frees the memory in a thread of its own, in which it needs some time.
            del item
            yield batch


class _Recipe:
    """Step -> batch, as an object that travels to the workers."""

    def __init__(
        self,
        frames: FrameSet,
        config: Config,
        seed: int,
        num_steps: int,
        objects: ObjectDatabase | None,
        process_index: int,
        num_processes: int,
    ) -> None:
        import grain

        size = config.optimizer.batch_size
        if not 0 <= process_index < num_processes or size % num_processes:
            raise ValueError(
                f"process {process_index} of {num_processes}: expected a number that divides the batch of {size}"
            )
        if not len(frames):
            raise ValueError("training frames: got none, expected at least one")
        self.frames, self.config, self.seed = frames, config, seed
        share = size // num_processes
        self.rows = range(process_index * share, (process_index + 1) * share)
        self.epoch = epoch_frames(frames, config, seed=seed)
        self.fade_step = num_steps - config.fade_epochs * steps_per_epoch(len(self.epoch), size)
        # grain adds the epoch to its seed: seeds far apart keep two runs from sharing orders.
        shuffle_seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        self.order: Any = grain.MapDataset.range(len(self.epoch)).shuffle(seed=shuffle_seed).repeat()
        self.paste = None
        if config.copy_paste is not None:
            if objects is None:
                raise ValueError("copy_paste: got no object database, expected one, or None in the configuration")
            self.paste = make_paste(objects, config.copy_paste, current_only=config.num_sweeps == 1)

    def __call__(self, step: int) -> HostBatch:
        config, first = self.config, step * self.config.optimizer.batch_size
        counts = {"overflow_points": 0, "overflow_boxes": 0, "pasted_objects": 0}
        batch: Batch | None = None
        shown = [int(self.epoch[self.order[first + row]]) for row in self.rows]
        for row, index in enumerate(shown):
            frame = self.frames.frame(index)
            pasted = self.pasted(frame, first + self.rows[row], step)
            if batch is None:
                batch = empty_batch(
                    len(self.rows),
                    max_points=config.max_points,
                    max_boxes=config.max_boxes,
                    columns=frame.points.shape[1],
                )
            counts["overflow_points"] += fill_points(batch, row, [frame.points, pasted.points], pasted.removed)
            truth = frame.num_points >= 1
            counts["overflow_boxes"] += fill_boxes(
                batch,
                row,
                np.concatenate([frame.boxes[truth], pasted.boxes]),
                np.concatenate([frame.labels[truth], pasted.labels]),
                np.concatenate([frame.num_points[truth], pasted.num_points]),
            )
            counts["pasted_objects"] += len(pasted.boxes)
        assert batch is not None
        return HostBatch(batch, step, counts, tuple(self.frames.name(index) for index in shown))

    def pasted(self, frame: Frame, position: int, step: int) -> Paste:
        """What is pasted into the frame at a position of the stream."""
        if self.paste is None or step >= self.fade_step:
            return Paste.nothing(frame)
        return self.paste(frame, np.random.default_rng([self.seed, position]))
