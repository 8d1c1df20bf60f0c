"""The sensors that recorded the point files of known data sets, and the scale of intensities."""

import math
import os
from collections.abc import Iterable
from pathlib import Path

from fcos_lidar_jax.fields import check
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, Sensor

RECORDED_BY = {
    "training/velodyne/*.bin": KITTI_HDL64E,
    "testing/velodyne/*.bin": KITTI_HDL64E,
    "training/velodyne/*/*.bin": KITTI_HDL64E,  # tracking benchmark
    "testing/velodyne/*/*.bin": KITTI_HDL64E,
    "velodyne_points/data/*.bin": KITTI_HDL64E,  # raw drives
    "sensors/lidar/*.feather": ARGOVERSE2,
}
"""Ends of paths -> the sensor whose heading, position and intensity scale the files have."""


def recorded_by(path: Path) -> Sensor | None:
    """The sensor that recorded a point file, or the files of a recording's folder; None if the path does not tell.

    >>> recorded_by(Path("KITTI/training/velodyne/000000.bin")).name, recorded_by(Path("000000.bin"))
    ('kitti_hdl64e', None)
    """
    path = Path(os.path.abspath(path))
    found = (sensor for end, sensor in RECORDED_BY.items() if path.match(end) or any(path.glob(end)))
    return next(found, None)


def check_scale(intensity_scale: float | None, files: Iterable[Path]) -> None:
    """Refuse a factor for intensities that is not positive, or that files would not use.

    Raises:
        ValueError: with the factor, and a ``.pcd.bin`` file: its intensities are always from 0 to 255.
    """
    if intensity_scale is None:
        return
    check(0 < intensity_scale < math.inf, "intensity scale", intensity_scale, "a positive number")
    if file := next((file for file in files if file.name.lower().endswith(".pcd.bin")), None):
        raise ValueError(f"{file}: intensity scale: got {intensity_scale:g}, expected none: it is 1 in .pcd.bin")
