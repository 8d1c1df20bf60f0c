"""Several sweeps fused into the frame of the current one."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.point_files import PointFileError, read_points
from fcos_lidar_jax.sensors import Sensor


def read_sweeps(
    path: str | Path, sensor: Sensor, *, remove_close: str, close_m: float, num_sweeps: int | None = None
) -> tuple[np.ndarray, int]:
    """The fused cloud of a JSON list of sweeps, current points first, then by age as listed.

    The list is ``[{"file", "timestamp_us", "sensor_to_world": 4x4}, ...]``, the first entry the current sweep;
    file names are relative to the list's folder. Poses are composed in float64 and times subtracted as whole
    microseconds; only the result is float32.

    Args:
        path: the JSON file.
        sensor: whose points they are.
        remove_close: drop the points on the vehicle, judged in each sweep's own frame: ``"all"`` sweeps,
            the older ``"sweeps"``, or ``"none"``.
        close_m: half the side of the square that is emptied.
        num_sweeps: how many of the list to read at most, from the current one on; None for all.

    Returns:
        f32[n, c] in the frame of the current sweep, the lag in seconds; and how many points were dropped.

    Raises:
        PointFileError: naming the file, the entry, the field, what was found and what was expected.
    """
    if remove_close not in ("all", "sweeps", "none"):
        raise ValueError(f"remove_close: got {remove_close!r}, expected 'all', 'sweeps' or 'none'")
    path = Path(path)
    entries = _read_entries(path)[:num_sweeps]
    now_us = entries[0]["timestamp_us"]
    world_to_current = np.linalg.inv(entries[0]["sensor_to_world"])
    parts, num_close = [], 0
    for index, entry in enumerate(entries):
        lag_us = now_us - entry["timestamp_us"]
        if lag_us < 0 or (lag_us == 0) != (index == 0):
            raise PointFileError(
                f"{path}: [{index}].timestamp_us: got {entry['timestamp_us']}, expected less than the current "
                f"sweep's {now_us}"
            )
        points = read_points(path.parent / entry["file"], sensor)
        if remove_close == "all" or (remove_close == "sweeps" and index > 0):
            near = (np.abs(points[:, :2] - np.array(sensor.origin_m[:2])) < close_m).all(axis=1)
            num_close += int(near.sum())
            points = points[~near]
        motion = world_to_current @ entry["sensor_to_world"]
        xyz = points[:, :3].astype(np.float64)
        # The current sweep keeps its very bits.
        points[:, :3] = points[:, :3] if index == 0 else xyz @ motion[:3, :3].T + motion[:3, 3]
        points[:, 4] = lag_us / 1e6
        parts.append(points)
    return np.concatenate(parts), num_close


def _read_entries(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        raise PointFileError(f"{path}: no such file, expected a JSON list of sweeps")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise PointFileError(f"{path}: not JSON: {error}") from None
    if not isinstance(entries, list) or not entries:
        raise PointFileError(f"{path}: got {type(entries).__name__}, expected a list of at least one sweep")
    return [_check_entry(entry, f"{path}: [{index}]") for index, entry in enumerate(entries)]


def _check_entry(entry: Any, where: str) -> dict[str, Any]:
    if not isinstance(entry, dict):
        raise PointFileError(f"{where}: got {type(entry).__name__}, expected an object")
    for name in ("file", "timestamp_us", "sensor_to_world"):
        if name not in entry:
            raise PointFileError(f"{where}.{name}: missing")
    if not isinstance(entry["file"], str):
        raise PointFileError(f"{where}.file: got {entry['file']!r}, expected a file name")
    stamp = entry["timestamp_us"]
    if isinstance(stamp, bool) or not isinstance(stamp, int):
        raise PointFileError(f"{where}.timestamp_us: got {stamp!r}, expected whole microseconds")
    return {**entry, "sensor_to_world": _check_pose(entry["sensor_to_world"], f"{where}.sensor_to_world")}


def _check_pose(value: Any, where: str) -> np.ndarray:
    def is_number(v: Any) -> bool:
        return isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)

    rows_fit = isinstance(value, list) and len(value) == 4
    if not rows_fit or not all(isinstance(r, list) and len(r) == 4 and all(map(is_number, r)) for r in value):
        raise PointFileError(f"{where}: expected 4 rows of 4 finite numbers")
    pose = np.array(value, np.float64)
    rotation = pose[:3, :3]
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise PointFileError(f"{where}: last row: got {value[3]}, expected [0, 0, 0, 1]")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise PointFileError(f"{where}: the upper left 3x3 is not a rotation")
    return pose
