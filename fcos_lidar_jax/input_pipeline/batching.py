"""Padding of frames to batches of a fixed size."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from fcos_lidar_jax.data.box_geometry import check_boxes
from fcos_lidar_jax.data.cloud_policy import usable_rows, write_points
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.point_files import check_time_lags
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.types import Batch


def empty_batch(size: int, *, max_points: int, max_boxes: int, columns: int) -> Batch:
    """A batch of zeroed NumPy arrays, without valid rows."""
    arrays: Any = (
        np.zeros((size, max_points, columns), np.float32),
        np.zeros((size, max_points), bool),
        np.zeros((size, max_boxes, 9), np.float32),
        np.zeros((size, max_boxes), np.int32),
        np.zeros((size, max_boxes), bool),
    )
    return Batch(*arrays)


def fill_row(
    batch: Batch, row: int, parts: Sequence[Frame], removed: Sequence[int] | np.ndarray = ()
) -> dict[str, int]:
    """Write one sample into a row of a batch from :func:`empty_batch`.

    Points follow the policy of :mod:`fcos_lidar_jax.data.cloud_policy`. If there are too many boxes, those
    with the fewest points are dropped, the last ones first on ties; the order is preserved.

    Args:
        parts: the frame, and objects pasted into it.
        removed: i64[k], rows of points to drop, counted through the parts.

    Returns:
        the numbers ``truncated_points``, ``truncated_boxes`` and ``invalid_points`` (not finite or beyond physical
        limits).
    """
    points, valid, boxes, labels, box_valid = (
        cast(np.ndarray, array)[row]
        for array in (batch.points, batch.valid, batch.boxes, batch.labels, batch.box_valid)
    )
    kept = np.concatenate([usable_rows(part.points) for part in parts])
    num_invalid = int((~kept).sum())
    kept[np.asarray(removed, np.int64)] = False
    truncated = write_points([part.points for part in parts], kept, points, valid)
    num_points = np.concatenate([part.num_points for part in parts])
    fullest = np.sort(np.argsort(-num_points, kind="stable")[: len(boxes)])
    boxes[: len(fullest)] = np.concatenate([part.boxes for part in parts])[fullest]
    labels[: len(fullest)] = np.concatenate([part.labels for part in parts])[fullest]
    box_valid[: len(fullest)] = True
    num_lost = len(num_points) - len(fullest)
    return {"truncated_points": truncated, "truncated_boxes": num_lost, "invalid_points": num_invalid}


def make_batch(frames: Sequence[Frame], *, max_points: int, max_boxes: int) -> Batch:
    """Pad at least one frame to a common shape and stack them; all have the same point columns.

    Args:
        frames: frames with labels by the classes of the detector, see
            :class:`~fcos_lidar_jax.data.class_mapping.MappedFrames`.

    Returns:
        NumPy arrays. Rows of points that are not finite or beyond physical limits are left out. Points on the ego
        vehicle stay: readers remove them, and :func:`~fcos_lidar_jax.data.frame.drop_close` from your own arrays.

    Raises:
        ValueError: arrays that do not fit each other, an implausible box, or a frame that is too large; nothing is
            truncated.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> frames = SimulatedFrames(TINY, 2)
    >>> batch = make_batch([frames.frame(i) for i in range(2)], max_points=4096, max_boxes=64)
    >>> batch.points.shape, batch.boxes.shape, batch.box_valid.sum(axis=1).tolist() == [
    ...     len(frames.labels(i)) for i in range(2)
    ... ]
    ((2, 4096, 5), (2, 64, 9), True)
    """
    columns = frames[0].points.shape[-1]
    for row, frame in enumerate(frames):
        _check_frame(f"frame {row}", frame)
    batch = empty_batch(len(frames), max_points=max_points, max_boxes=max_boxes, columns=columns)
    for row, frame in enumerate(frames):
        for name, rows, limit in (("points", frame.points, max_points), ("boxes", frame.boxes, max_boxes)):
            check(len(rows) <= limit, f"frame {row}: {name}", len(rows), f"at most {limit}")
        fill_row(batch, row, [frame])
    return batch


def _check_frame(where: str, frame: Frame) -> None:
    """Refuse a frame whose arrays do not fit each other, or with an implausible box or label."""
    number = len(frame.boxes)
    for name, shape in (("boxes", (number, 9)), ("labels", (number,)), ("num_points", (number,))):
        found = getattr(frame, name).shape
        check(found == shape, f"{where}: {name}: shape", found, f"{shape}")
    check_time_lags(frame.points[:, 4], f"{where}: points")
    check_boxes(frame.boxes, lambda box: f"{where}: box {box}")
    least = int(frame.labels.min(initial=0))
    check(least >= 0, f"{where}: labels", least, "indices of classes, from 0")
