"""Several sweeps fused into the frame of the current one."""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.point_files import PointFileError, read_points
from fcos_lidar_jax.projection import close_to_sensor
from fcos_lidar_jax.sensors import Sensor

FARTHEST_M = 1e8
"""Beyond any place on earth in any map's coordinates."""


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One turn of a sensor."""

    points: np.ndarray
    """f32[n, c]: x, y, z, intensity, (anything,) and what more there is, in the sweep's own frame."""
    sensor_to_world: np.ndarray
    """f64[4, 4] from that frame."""
    time_us: int
    """When it was taken."""


def fuse_sweeps(
    sweeps: Iterable[Sweep], sensor: Sensor, *, remove_close: str, close_m: float
) -> tuple[np.ndarray, int]:
    """Sweeps in the frame of the first, which is the current one (paper, section 4).

    Poses are composed in float64 and times subtracted as whole microseconds; only the result is float32. The
    current sweep's coordinates stay bit-identical.

    Args:
        sweeps: the current one, then the others by age.
        sensor: whose points they are.
        remove_close: drop the points on the ego vehicle, judged in each sweep's own frame: of ``"all"`` sweeps, of
            the older ``"sweeps"``, or ``"none"``.
        close_m: half the side of the square that is emptied, metres.

    Returns:
        f32[n, c] with the time lag in seconds as fifth column, exactly 0 for the current sweep; and how many
        points were dropped.

    Raises:
        ValueError: unknown ``remove_close``.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> there, before = np.eye(4), np.eye(4)
    >>> there[0, 3] = 2.0  # the ego vehicle went on by two metres
    >>> point = np.array([[9, 0, 0, 1, 0]], np.float32)
    >>> sweeps = Sweep(point, there, 500), Sweep(point, before, 0)
    >>> fuse_sweeps(sweeps, TINY, remove_close="all", close_m=1.0)[0][:, 0].tolist()
    [9.0, 7.0]
    """
    if remove_close not in ("all", "sweeps", "none"):
        raise ValueError(f"remove_close: got {remove_close!r}, expected 'all', 'sweeps' or 'none'")
    parts, num_close = [], 0
    now_us, world_to_current = 0, np.eye(4)
    for index, sweep in enumerate(sweeps):
        points = sweep.points.copy()
        if remove_close == "all" or (remove_close == "sweeps" and index > 0):
            close = np.asarray(close_to_sensor(points, sensor, close_m))
            num_close += int(close.sum())
            points = points[~close]
        if index == 0:
            now_us, world_to_current = sweep.time_us, np.linalg.inv(sweep.sensor_to_world)
        else:
            motion = world_to_current @ sweep.sensor_to_world
            points[:, :3] = points[:, :3].astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
        points[:, 4] = (now_us - sweep.time_us) / 1e6
        parts.append(points)
    return np.concatenate(parts), num_close


@dataclasses.dataclass(frozen=True)
class ListedSweep:
    """An entry of a list of sweeps."""

    file: Path
    """Point file."""
    sensor_to_world: np.ndarray
    """f64[4, 4]."""
    time_us: int
    """When it was taken."""


def read_sweeps(
    path: str | Path, sensor: Sensor, *, remove_close: str, close_m: float, num_sweeps: int | None = None
) -> tuple[np.ndarray, int]:
    """The fused cloud of a JSON list of sweeps, as :func:`fuse_sweeps` gives it.

    Args:
        path: the JSON file, see :func:`read_list`.
        sensor: whose points they are.
        remove_close: as in :func:`fuse_sweeps`.
        close_m: as in :func:`fuse_sweeps`.
        num_sweeps: how many of the list to read at most, from the current one on; None for all.

    Raises:
        PointFileError: naming the file, the entry, the field, what was found and what was expected.
    """
    listed = read_list(path)[:num_sweeps]
    sweeps = (Sweep(read_points(each.file, sensor), each.sensor_to_world, each.time_us) for each in listed)
    return fuse_sweeps(sweeps, sensor, remove_close=remove_close, close_m=close_m)


def read_list(path: str | Path) -> list[ListedSweep]:
    """The sweeps of a JSON list ``[{"file", "timestamp_us", "sensor_to_world": 4x4}, ...]``.

    The first entry is the current sweep, the others follow by age; file names are relative to the list's folder.

    Raises:
        PointFileError: naming the file, the entry, the field, what was found and what was expected.
    """
    path = Path(path)
    if not path.is_file():
        raise PointFileError(f"{path}: no such file, expected a JSON list of sweeps")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise PointFileError(f"{path}: not JSON: {error}") from None
    if not isinstance(entries, list) or not entries:
        raise PointFileError(f"{path}: got {type(entries).__name__}, expected a list of at least one sweep")
    sweeps = [_check_entry(entry, path, f"{path}: [{index}]") for index, entry in enumerate(entries)]
    now_us = sweeps[0].time_us
    for index, sweep in enumerate(sweeps[1:], start=1):
        if sweep.time_us >= now_us:
            raise PointFileError(
                f"{path}: [{index}].timestamp_us: got {sweep.time_us}, expected less than the current sweep's "
                f"{now_us}"
            )
    return sweeps


def _check_entry(entry: Any, path: Path, where: str) -> ListedSweep:
    if not isinstance(entry, dict):
        raise PointFileError(f"{where}: got {type(entry).__name__}, expected an object")
    for name in ("file", "timestamp_us", "sensor_to_world"):
        if name not in entry:
            raise PointFileError(f"{where}.{name}: missing")
    if not isinstance(entry["file"], str):
        raise PointFileError(f"{where}.file: got {entry['file']!r}, expected a file name")
    stamp = entry["timestamp_us"]
    if isinstance(stamp, bool) or not isinstance(stamp, int) or abs(stamp) >= 2**63:
        raise PointFileError(f"{where}.timestamp_us: got {str(stamp)[:32]}, expected whole microseconds, 64 bits")
    pose = _check_pose(entry["sensor_to_world"], f"{where}.sensor_to_world")
    return ListedSweep(path.parent / entry["file"], pose, stamp)


def _check_pose(value: Any, where: str) -> np.ndarray:
    def is_number(v: Any) -> bool:
        return isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= FARTHEST_M

    rows_fit = isinstance(value, list) and len(value) == 4
    if not rows_fit or not all(isinstance(r, list) and len(r) == 4 and all(map(is_number, r)) for r in value):
        raise PointFileError(f"{where}: expected 4 rows of 4 finite numbers of at most {FARTHEST_M:g}")
    pose = np.array(value, np.float64)
    rotation = pose[:3, :3]
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise PointFileError(f"{where}: last row: got {value[3]}, expected [0, 0, 0, 1]")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise PointFileError(f"{where}: the upper left 3x3 is not a rotation")
    return pose
