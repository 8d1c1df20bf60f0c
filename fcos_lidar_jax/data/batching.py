"""Frames to fixed-size batches."""

from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np

from fcos_lidar_jax.types import Batch


class Sample(Protocol):
    """What a batch is made of."""

    @property
    def points(self) -> np.ndarray:
        """f32[n, c]: x, y, z, intensity, time lag, ..."""
        ...

    @property
    def boxes(self) -> np.ndarray:
        """f32[m, 9]."""
        ...

    @property
    def labels(self) -> np.ndarray:
        """i32[m]."""
        ...


def empty_batch(size: int, *, max_points: int, max_boxes: int, columns: int) -> Batch:
    """NumPy arrays of a batch in which nothing is valid yet, all zero.

    >>> empty_batch(2, max_points=8, max_boxes=4, columns=5).points.shape
    (2, 8, 5)
    """
    # NumPy arrays, which travel to the device later.
    arrays: Any = (
        np.zeros((size, max_points, columns), np.float32),
        np.zeros((size, max_points), bool),
        np.zeros((size, max_boxes, 9), np.float32),
        np.zeros((size, max_boxes), np.int32),
        np.zeros((size, max_boxes), bool),
    )
    return Batch(*arrays)


def fill_points(batch: Batch, row: int, parts: Sequence[np.ndarray], removed: np.ndarray) -> int:
    """Write one sample's points into a row of a batch of NumPy arrays.

    Where they are too many, the largest lags go first, so that the oldest sweeps lose points and the current one
    only when it alone is too large; among equal lags the last points go.

    Args:
        batch: from :func:`empty_batch`.
        row: which sample.
        parts: f32[n, c] each, written one behind another.
        removed: i64[k], rows to leave out, counted through the parts: they stay in place, invalid, where all fits.

    Returns:
        how many points found no room.

    >>> batch = empty_batch(1, max_points=2, max_boxes=1, columns=5)
    >>> cloud = np.array([[1, 0, 0, 0, 0], [2, 0, 0, 0, 0.1], [3, 0, 0, 0, 0]], np.float32)
    >>> fill_points(batch, 0, [cloud], np.zeros(0, int)), batch.points[0, :, 0].tolist()
    (1, [1.0, 3.0])
    """
    points, valid = cast(np.ndarray, batch.points)[row], cast(np.ndarray, batch.valid)[row]
    overflow = 0
    if sum(map(len, parts)) > len(points):
        cloud = np.concatenate(parts)
        cloud = np.delete(cloud, removed, axis=0)
        overflow = max(len(cloud) - len(points), 0)
        newest = np.sort(np.argsort(cloud[:, 4], kind="stable")[: len(points)])
        parts, removed = [cloud[newest]], removed[:0]
    end = 0
    for part in parts:
        points[end : end + len(part)] = part
        end += len(part)
    valid[:end] = True
    valid[removed] = False
    return overflow


def fill_boxes(batch: Batch, row: int, boxes: np.ndarray, labels: np.ndarray, num_points: np.ndarray) -> int:
    """Write one sample's boxes into a row of a batch of NumPy arrays.

    Where they are too many, those with the fewest points go, among equals the last; the others keep their order.

    Args:
        batch: from :func:`empty_batch`.
        row: which sample.
        boxes: f32[m, 9].
        labels: i32[m].
        num_points: i32[m], points of each box.

    Returns:
        how many boxes found no room.
    """
    room = batch.box_valid.shape[1]
    kept = np.sort(np.argsort(-num_points, kind="stable")[:room])
    cast(np.ndarray, batch.boxes)[row, : len(kept)] = boxes[kept]
    cast(np.ndarray, batch.labels)[row, : len(kept)] = labels[kept]
    cast(np.ndarray, batch.box_valid)[row, : len(kept)] = True
    return len(boxes) - len(kept)


def make_batch(samples: Sequence[Sample], *, max_points: int, max_boxes: int) -> Batch:
    """Pad samples to one shape and stack them.

    Args:
        samples: at least one, with the same number of point columns.
        max_points: rows of points a sample.
        max_boxes: rows of boxes a sample.

    Raises:
        ValueError: when a sample is larger; nothing is dropped silently.

    >>> from fcos_lidar_jax.data.synthetic.frames import make_frame
    >>> from fcos_lidar_jax.sensors import TINY
    >>> make_batch([make_frame(0, TINY)], max_points=4096, max_boxes=32).points.shape
    (1, 4096, 5)
    """
    for index, sample in enumerate(samples):
        for name, rows, limit in (
            ("points", len(sample.points), max_points),
            ("boxes", len(sample.boxes), max_boxes),
        ):
            if rows > limit:
                raise ValueError(f"sample {index}: {name}: got {rows}, expected at most {limit}")
    columns = samples[0].points.shape[1]
    batch = empty_batch(len(samples), max_points=max_points, max_boxes=max_boxes, columns=columns)
    for row, sample in enumerate(samples):
        fill_points(batch, row, [sample.points], np.zeros(0, np.int64))
        fill_boxes(batch, row, sample.boxes, sample.labels, np.zeros(len(sample.boxes)))
    return batch
