"""KITTI raw recordings: LiDAR sweeps with the poses of the GPS and inertial unit (oxts)."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.drives import Drive
from fcos_lidar_jax.data.point_files import MAX_POINTS, read_points
from fcos_lidar_jax.data.sweeps import FARTHEST_M, Sweep
from fcos_lidar_jax.data.text_files import read_lines, read_matrices, read_number
from fcos_lidar_jax.files import refusing, some_files
from fcos_lidar_jax.sensors import Sensor

_EARTH_RADIUS_M = 6_378_137.0
_CALIBRATION = "calib_imu_to_velo.txt"
_OXTS = ("latitude", "longitude", "altitude", "roll", "pitch", "yaw")
_LIMITS = {"latitude": 89.99}  # degrees; the projection ends at the poles


def is_kitti_raw(folder: Path) -> bool:
    """Whether a folder is a recording, such as ``2011_09_26/2011_09_26_drive_0001_sync``."""
    return (folder / "velodyne_points" / "data").is_dir()


def kitti_raw_drive(folder: Path, sensor: Sensor, *, max_points: int = MAX_POINTS) -> Drive:
    """The sweeps of a synchronised recording (``_sync``).

    Reads ``velodyne_points/data/N.bin``, line N of ``velodyne_points/timestamps.txt``, ``oxts/data/N.txt``, and
    ``calib_imu_to_velo.txt`` in the folder or its parent. Positions are in a Mercator projection scaled at the
    first latitude, as in the data set's development kit.
    """
    points = folder / "velodyne_points"
    files = some_files(points / "data", ".bin", "sweeps")
    times = dict(read_lines(points / "timestamps.txt", "the times of the sweeps"))
    own, of_day = folder / _CALIBRATION, folder.absolute().parent / _CALIBRATION
    matrices = read_matrices(own if own.is_file() else of_day, {"R": (3, 3), "T": (3, 1)}, ("R",))
    velodyne_to_imu = np.linalg.inv(np.vstack([np.hstack([matrices["R"], matrices["T"]]), (0, 0, 0, 1)]))

    def read() -> Iterator[Sweep]:
        scale = None
        for file in files:
            oxts = _read_oxts(folder / "oxts" / "data" / f"{file.stem}.txt")
            scale = np.cos(np.deg2rad(oxts["latitude"])) if scale is None else scale
            pose = _imu_to_world(**oxts, scale=float(scale)) @ velodyne_to_imu
            time_us = _time_us(times, points / "timestamps.txt", file)
            yield Sweep(read_points(file, sensor, max_points=max_points), pose, time_us, str(file))

    return Drive(read())


def _read_oxts(file: Path) -> dict[str, float]:
    """Latitude and longitude (degrees), altitude (m), roll, pitch and yaw (radians)."""
    words = [word for _, line in read_lines(file, "the pose of a sweep") for word in line]
    if len(words) < len(_OXTS):
        raise ValueError(f"{file}: got {len(words)} numbers, expected at least {len(_OXTS)}")
    return {
        name: read_number(word, f"{file}: {name}", largest=_LIMITS.get(name, FARTHEST_M))
        for name, word in zip(_OXTS, words, strict=False)
    }


def _imu_to_world(
    latitude: float, longitude: float, altitude: float, roll: float, pitch: float, yaw: float, *, scale: float
) -> np.ndarray:
    from scipy.spatial.transform import Rotation  # SciPy takes long to import

    north = np.log(np.tan(np.deg2rad(90 + latitude) / 2))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    pose[:3, 3] = (*(scale * _EARTH_RADIUS_M * np.array([np.deg2rad(longitude), north])), altitude)
    return pose


def _time_us(times: dict[str, list[str]], timestamps: Path, sweep: Path) -> int:
    line = int(sweep.stem) + 1 if sweep.stem.isdecimal() and len(sweep.stem) < 19 else 0
    where = f"{timestamps}: line {line}"
    text = " ".join(times.get(where, []))
    with refusing(
        f"{where}: time of {sweep.name}", ValueError, more=", expected 2011-09-26 13:02:25.59 or the like"
    ):
        since = datetime.fromisoformat(text).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1)
