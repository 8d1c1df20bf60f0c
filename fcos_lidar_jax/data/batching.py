"""Frames to fixed-size batches."""

from collections.abc import Sequence
from typing import Protocol

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

    def stack(arrays: list[np.ndarray], size: int) -> np.ndarray:
        padded = np.zeros((len(arrays), size, *arrays[0].shape[1:]), arrays[0].dtype)
        for row, array in zip(padded, arrays, strict=True):
            row[: len(array)] = array
        return padded

    return Batch(
        points=stack([s.points for s in samples], max_points),  # type: ignore[arg-type]
        valid=np.array([np.arange(max_points) < len(s.points) for s in samples]),  # type: ignore[arg-type]
        boxes=stack([s.boxes for s in samples], max_boxes),  # type: ignore[arg-type]
        labels=stack([s.labels for s in samples], max_boxes),  # type: ignore[arg-type]
        box_valid=np.array([np.arange(max_boxes) < len(s.boxes) for s in samples]),  # type: ignore[arg-type]
    )
