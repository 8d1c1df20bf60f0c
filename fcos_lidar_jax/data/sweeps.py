"""Fusion of several sweeps in the current sweep's frame."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.cloud_policy import usable_rows
from fcos_lidar_jax.data.frame import drop_close
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.files import read_json, refusing
from fcos_lidar_jax.sensors import Sensor

GAP_US = (1_000, 10_000_000)  # plausible mean time between sweeps; others are not microseconds
FARTHEST_M = 1e8  # beyond any place on earth in any map's coordinates

Metres = Annotated[float, msgspec.Meta(ge=-FARTHEST_M, le=FARTHEST_M)]
_Row = tuple[Metres, Metres, Metres, Metres]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One turn of a sensor."""

    points: np.ndarray  # f32[n, c] in its own frame: x, y, z, intensity, (overwritten by the lag), more columns
    sensor_to_world: np.ndarray  # f64[4, 4] from that frame
    time_us: int
    name: str = ""  # in messages and results


class ListedSweep(msgspec.Struct):
    """An entry of a list of sweeps."""

    file: str  # point file, relative to the list's folder
    timestamp_us: Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
    sensor_to_world: tuple[_Row, _Row, _Row, _Row]  # from the sweep's own frame


def fuse_sweeps(sweeps: Iterable[Sweep], sensor: Sensor, reading: CloudReading) -> tuple[np.ndarray, int]:
    """Fuse sweeps in the frame of the first, which is the current one (paper, section 4).

    Composes poses in float64 and subtracts times as whole microseconds; only the result is float32. The current
    sweep's coordinates stay bit-identical.

    Args:
        sweeps: the current sweep, then the others by age; all of them are fused.
        reading: which points on the ego vehicle are dropped.

    Returns:
        f32[n, c] with the time lag in seconds as fifth column, exactly 0 for the current sweep; and the number of
        dropped points.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> there, before = np.eye(4), np.eye(4)
    >>> there[0, 3] = 2.0  # the ego vehicle went on by two metres
    >>> point = np.array([[9, 0, 0, 1, 0]], np.float32)
    >>> sweeps = Sweep(point, there, 500), Sweep(point, before, 0)
    >>> fuse_sweeps(sweeps, TINY, CloudReading(2))[0][:, 0].tolist()
    [9.0, 7.0]
    """
    parts, num_close, now_us, world_to_current = [], 0, 0, np.eye(4)
    for index, sweep in enumerate(sweeps):
        if index == 0:
            now_us, world_to_current = sweep.time_us, np.linalg.inv(sweep.sensor_to_world)
        points = sweep.points.copy()
        points[:, 4] = (now_us - sweep.time_us) / 1e6
        points, close = drop_close(points, sensor, reading)
        num_close += close
        if index > 0:
            motion = world_to_current @ sweep.sensor_to_world
            # Coordinates may overflow to infinity; the cloud policy removes such rows.
            with np.errstate(over="ignore", invalid="ignore"):
                points[:, :3] = points[:, :3].astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
        parts.append(points)
    return np.concatenate(parts), num_close


def read_sweeps(path: Path, sensor: Sensor, reading: CloudReading, **layout: Any) -> tuple[np.ndarray, int]:
    """Fuse the sweeps of a JSON list, at most ``reading.num_sweeps``; returns the result of :func:`fuse_sweeps`.

    Without usable points in the current sweep, older sweeps are left out: as in ``stream``, there is nothing to
    detect. ``layout`` are options of :func:`~fcos_lidar_jax.data.point_files.read_points`, for each file.
    """

    def read(index: int, each: ListedSweep) -> Sweep:
        with refusing(f"{path}: $[{index}].file", ValueError):
            points = read_points(path.parent / each.file, sensor, num_sweeps=1, **layout)
        return Sweep(points, np.array(each.sensor_to_world), each.timestamp_us)

    sweeps = (read(index, each) for index, each in enumerate(read_list(path)[: reading.num_sweeps]))
    current = next(sweeps)
    points, num_close = fuse_sweeps([current], sensor, reading)
    if not np.any(usable_rows(points)):
        return points, num_close
    return fuse_sweeps(itertools.chain([current], sweeps), sensor, reading)


def read_list(path: Path) -> list[ListedSweep]:
    """Read a JSON list ``[{"file", "timestamp_us", "sensor_to_world": 4x4}, ...]`` of sweeps.

    The first entry is the current sweep; the others follow by age, newest first.
    """
    sweeps = read_entries(path)
    for index, (newer, sweep) in enumerate(itertools.pairwise(sweeps), 1):
        if sweep.timestamp_us >= newer.timestamp_us:
            expected = f"less than {newer.timestamp_us} of the entry before: the current sweep first, then by age"
            raise ValueError(f"{path}: $[{index}].timestamp_us: got {sweep.timestamp_us}, expected {expected}")
    return sweeps


def read_entries(path: Path) -> list[ListedSweep]:
    """:func:`read_list` in any temporal order."""
    sweeps = read_json(path, Annotated[list[ListedSweep], msgspec.Meta(min_length=1)], what="sweeps")
    for index, sweep in enumerate(sweeps):
        where, pose = f"{path}: $[{index}]", np.array(sweep.sensor_to_world)
        if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6 or not is_rotation(pose[:3, :3]):
            expected = "a rotation in the upper left 3x3, and 0, 0, 0, 1 as the last row"
            raise ValueError(f"{where}.sensor_to_world: got {pose.tolist()}, expected {expected}")
    times = [sweep.timestamp_us for sweep in sweeps]
    gap_us = (max(times) - min(times)) / max(len(sweeps) - 1, 1)
    if len(sweeps) > 1 and not GAP_US[0] <= gap_us <= GAP_US[1]:
        expected = f"microseconds, {GAP_US[0]} to {GAP_US[1]} from sweep to sweep"
        raise ValueError(f"{path}: timestamp_us: got {gap_us:g} on average, expected {expected}")
    return sweeps


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether the rows of a 3x3 matrix are orthonormal, to 1e-3, and right-handed."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(matrix) > 0)


def check_poses(rotation: np.ndarray, translation: np.ndarray, place: Callable[[int], str]) -> None:
    """Refuse rotations of another length than 1, and translations beyond :data:`FARTHEST_M`.

    Args:
        rotation: f64[n, 4], quaternions w, x, y, z.
        translation: f64[n, 3], metres.
        place: row -> name of a pose, for messages.
    """
    near = (np.abs(translation) <= FARTHEST_M).all(axis=1)
    with np.errstate(over="ignore"):  # lengths may overflow
        unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) < 1e-3
    for name, values, good, expected in (
        ("translation", translation, near, f"finite numbers of at most {FARTHEST_M:g} m"),
        ("rotation", rotation, unit, "a unit quaternion w, x, y, z"),
    ):
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(f"{place(row)}: {name}: got {values[row].tolist()}, expected {expected}")


def about_z(yaw_rad: float) -> np.ndarray:
    """A pose f64[4, 4] that rotates about z, counter-clockwise seen from above."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    return pose
