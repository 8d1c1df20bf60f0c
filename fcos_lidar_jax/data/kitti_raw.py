"""KITTI raw recordings: LiDAR sweeps with the poses of the GPS and inertial unit (oxts)."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.data.drives import Drive
from fcos_lidar_jax.data.point_files import MAX_POINTS, read_points
from fcos_lidar_jax.data.sweeps import FARTHEST_M, Sweep, is_rotation
from fcos_lidar_jax.sensors import Sensor

_EARTH_RADIUS_M = 6_378_137.0
_CALIBRATION = "calib_imu_to_velo.txt"


def is_kitti_raw(folder: Path) -> bool:
    """Whether a folder is a recording, such as ``2011_09_26/2011_09_26_drive_0001_sync``."""
    return (folder / "velodyne_points" / "data").is_dir()


def kitti_raw_drive(folder: Path, sensor: Sensor, *, max_points: int = MAX_POINTS) -> Drive:
    """The sweeps of a recording, synchronised (``_sync``) or not.

    Reads ``velodyne_points/data/N.bin``, line N of ``velodyne_points/timestamps.txt``, ``oxts/data/N.txt``, and
    ``calib_imu_to_velo.txt`` in the folder or its parent. Positions are in a Mercator projection scaled at the
    first latitude, as in the data set's development kit.

    Raises:
        ValueError: with the file, the found and the expected value.
    """
    points = folder / "velodyne_points"
    files = sorted(points.joinpath("data").glob("*.bin"))
    if not files:
        raise ValueError(f"{points / 'data'}: no .bin file in it, expected sweeps")
    times = _lines(points / "timestamps.txt")
    calibration = next((f for f in (folder / _CALIBRATION, folder.parent / _CALIBRATION) if f.is_file()), None)
    if calibration is None:
        raise ValueError(f"{folder.parent / _CALIBRATION}: no such file, expected the calibration of the day")
    velodyne_to_imu = np.linalg.inv(_imu_to_velodyne(calibration))

    def read() -> Iterator[Sweep]:
        scale = None
        for file in files:
            oxts = folder / "oxts" / "data" / f"{file.stem}.txt"
            values = _numbers(oxts, " ".join(_lines(oxts)), 6)
            scale = np.cos(np.deg2rad(values[0])) if scale is None else scale
            pose = _imu_to_world(oxts, values, float(scale)) @ velodyne_to_imu
            time_us = _time_us(points / "timestamps.txt", times, file)
            yield Sweep(read_points(file, sensor, max_points=max_points), pose, time_us, str(file))

    return Drive(read())


def _lines(file: Path) -> list[str]:
    if not file.is_file():
        raise ValueError(f"{file}: no such file, expected one of a KITTI raw recording")
    return file.read_text(encoding="utf-8", errors="replace").splitlines()


def _numbers(where: Path | str, text: str, number: int) -> np.ndarray:
    """The first numbers of a text, which must be finite."""
    words = text.split()[:number]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) < number or not (np.abs(values) < FARTHEST_M).all():
        raise ValueError(f"{where}: got {text[:80]!r}, expected {number} numbers")
    return values


def _imu_to_velodyne(file: Path) -> np.ndarray:
    fields = dict(line.split(":", 1) for line in _lines(file) if ":" in line)
    pose = np.eye(4)
    pose[:3, :3] = _numbers(f"{file}: R", fields.get("R", ""), 9).reshape(3, 3)
    pose[:3, 3] = _numbers(f"{file}: T", fields.get("T", ""), 3)
    if not is_rotation(pose[:3, :3]):
        raise ValueError(f"{file}: R: got {pose[:3, :3].tolist()}, expected a rotation")
    return pose


def _imu_to_world(file: Path, values: np.ndarray, scale: float) -> np.ndarray:
    """The pose f64[4, 4] for latitude, longitude (degrees), altitude (m), roll, pitch and yaw (radians)."""
    latitude, longitude, altitude, roll, pitch, yaw = values.tolist()
    if not abs(latitude) < 90:
        raise ValueError(f"{file}: latitude: got {latitude:g}, expected degrees between -90 and 90")
    north = np.log(np.tan(np.deg2rad(90 + latitude) / 2))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    pose[:3, 3] = (*(scale * _EARTH_RADIUS_M * np.array([np.deg2rad(longitude), north])), altitude)
    return pose


def _time_us(file: Path, lines: list[str], sweep: Path) -> int:
    number = int(sweep.stem) if sweep.stem.isdecimal() and len(sweep.stem) < 19 else len(lines)
    text = lines[number].strip() if number < len(lines) else ""
    try:
        since = datetime.fromisoformat(text).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    except ValueError:
        expected = "expected such as 2011-09-26 13:02:25.594360375"
        raise ValueError(f"{file}: time of {sweep.name}: got {text[:40]!r}, {expected}") from None
    return since // timedelta(microseconds=1)
