"""Annotated clouds, and what a data set of them offers."""

import dataclasses
from typing import Protocol

import numpy as np

from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class Frame:
    """Points and boxes of one keyframe in its LiDAR frame, unpadded."""

    points: np.ndarray
    """f32[n, c]: x, y, z, intensity (0-255), time lag (s, 0 for the current sweep), and the laser number as a
    sixth column for sensors whose rows come from it."""
    boxes: np.ndarray
    """f32[m, 9]: ``x, y, z, l, w, h, yaw, vx, vy``; NaN velocity where unknown."""
    labels: np.ndarray
    """i32[m]: index into ``types.CLASSES``."""
    num_points: np.ndarray
    """i32[m]: LiDAR points of the current sweep inside each box, as annotated."""


class FrameSet(Protocol):
    """Frames in a fixed order: what every reader offers to the training pipeline and the commands."""

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def frame(self, index: int) -> Frame:
        """One frame, read anew: sweeps fused, close points dropped, all boxes of the ten classes."""
        ...

    def labels(self, index: int) -> np.ndarray:
        """i32[m]: labels of the frame's boxes, without reading its points."""
        ...

    def name(self, index: int) -> str:
        """What messages call a frame."""
        ...


def without_close(frame: Frame, sensor: Sensor, *, mode: str = "all", close_m: float = 1.0) -> Frame:
    """The frame without the points on the vehicle that carries the sensor, as detectors are trained.

    Args:
        frame: of one sweep.
        sensor: gives the origin.
        mode: as in :func:`fcos_lidar_jax.projection.remove_close`.
        close_m: half the side of the square that is emptied.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> frame = Frame(np.eye(5, dtype=np.float32) * 9, np.zeros((0, 9)), np.zeros(0), np.zeros(0))
    >>> len(without_close(frame, TINY).points)
    2
    """
    everything = np.ones(len(frame.points), bool)
    kept = remove_close(frame.points, everything, sensor, mode=mode, close_m=close_m)
    return dataclasses.replace(frame, points=frame.points[np.asarray(kept)])


def inside_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Which points lie in an upright box, boundary included, bool[n]; in float64.

    Args:
        points: [n, >= 3], metres.
        box: ``x, y, z, l, w, h, yaw, ...``.

    >>> inside_box(np.array([[1.0, 0, 0], [3.0, 0, 0]]), np.array([0, 0, 0, 4, 2, 2, 0.0])).tolist()
    [True, False]
    """
    x, y, z, l, w, h, yaw = np.asarray(box, np.float64)[:7]
    dx, dy, dz = (points[:, i].astype(np.float64) - c for i, c in enumerate((x, y, z)))
    along, across = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
    return (np.abs(along) <= l / 2) & (np.abs(across) <= w / 2) & (np.abs(dz) <= h / 2)


def count_inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Points inside each upright box, boundary included, i32[m].

    >>> count_inside(np.zeros((2, 3)), np.array([[0, 0, 0, 1, 1, 1, 0.3]])).tolist()
    [2]
    """
    return np.array([int(inside_box(points, box).sum()) for box in boxes], np.int32)
