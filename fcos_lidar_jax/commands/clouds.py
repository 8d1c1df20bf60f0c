"""What all commands on point files share: filter, pad, count what was dropped."""

import dataclasses
from pathlib import Path

import numpy as np

from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import Sensor


class EmptyCloudError(ValueError):
    """No point of a file reaches the range image; the message names the file and says why."""


@dataclasses.dataclass(frozen=True)
class Cloud:
    """Points of one file, padded to a fixed count."""

    points: np.ndarray
    """f32[n, c]: rows of the file in their order, then padding."""
    valid: np.ndarray
    """bool[n]: rows that take part; padding and close points do not."""
    num_points: int
    """Rows of the file."""
    num_close: int
    """Rows on the carrying vehicle, dropped."""


def make_cloud(points: np.ndarray, sensor: Sensor, *, size: int, remove: str, close_m: float = 1.0) -> Cloud:
    """Drop the close points and pad.

    Args:
        points: f32[n, c] as read from a file.
        sensor: whose points they are.
        size: rows to pad to; a larger cloud is padded to the next multiple, which compiles once more.
        remove: ``"all"``, ``"sweeps"`` or ``"none"``, see :func:`fcos_lidar_jax.projection.remove_close`.
        close_m: half the side of the square that is emptied.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> cloud = make_cloud(np.zeros((3, 5), np.float32), TINY, size=8, remove="all")
    >>> cloud.points.shape, int(cloud.valid.sum()), cloud.num_close
    ((8, 5), 0, 3)
    """
    number = len(points)
    kept = np.asarray(remove_close(points, np.ones(number, bool), sensor, mode=remove, close_m=close_m))
    rows = max(1, -(-number // size)) * size
    padded = np.zeros((rows, points.shape[1]), np.float32)
    padded[:number] = points
    valid = np.zeros(rows, bool)
    valid[:number] = kept
    return Cloud(padded, valid, number, number - int(kept.sum()))


def expect_points(file: Path, cloud: Cloud, num_dropped: int, sensor: Sensor) -> None:
    """Refuse a cloud of which nothing is left.

    Raises:
        EmptyCloudError: naming the file and what became of its points.
    """
    if cloud.num_points - cloud.num_close > num_dropped:
        return
    broken = int((~np.isfinite(cloud.points)).any(axis=1).sum())
    low, high = sensor.limit_z_m
    raise EmptyCloudError(
        f"{file}: none of its {cloud.num_points} points is usable ({broken} not finite, "
        f"{cloud.num_close} on the vehicle itself, the others out of range or view), expected some with "
        f"|x|, |y| < {sensor.limit_xy_m:g} m and {low:g} < z < {high:g} m in the field of view of {sensor.name}"
    )
