"""The sensors that recorded point files, by their paths."""

import os
from collections.abc import Iterable
from pathlib import Path

from fcos_lidar_jax.data.folder import sensor_file
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E, Sensor, load_sensor

RECORDED_BY = {
    "training/velodyne/*.bin": KITTI_HDL64E,
    "testing/velodyne/*.bin": KITTI_HDL64E,
    "velodyne_points/data/*.bin": KITTI_HDL64E,
    "sensors/lidar/*.feather": ARGOVERSE2,
    "LIDAR_TOP/*.pcd.bin": NUSCENES_HDL32E,
    "*__LIDAR_TOP__*.pcd.bin": NUSCENES_HDL32E,
}
"""Ends of paths -> the sensor whose heading, position and intensity scale the files have."""


def usual_sensor(path: Path) -> Sensor | None:
    """The sensor of a point file, or of a recording in a folder, of a known data set."""
    path = Path(os.path.abspath(path))
    return next((sensor for end, sensor in RECORDED_BY.items() if path.match(end) or any(path.glob(end))), None)


def recorded_by(paths: Iterable[Path]) -> Sensor | None:
    """The one sensor that recorded point files, or recordings in folders: by own data's ``sensor.json``, or by
    :func:`usual_sensor`."""
    found: dict[Sensor | None, Path] = {}
    for path in {(path.parent, path.suffix): Path(os.path.abspath(path)) for path in paths}.values():
        file = sensor_file(path)
        found[usual_sensor(path) if file is None else load_sensor(file)] = path
    if len(found) > 1:
        files = " and ".join(f"{path} of {sensor.name if sensor else 'another'}" for sensor, path in found.items())
        raise ValueError(f"sensor: got {files}, expected files of one sensor, or --data-sensor for all")
    return next(iter(found), None)


def check_scale(intensity_scale: float | None, files: Iterable[Path]) -> None:
    """Refuse a factor for the intensities of a ``.pcd.bin``, which are always from 0 to 255."""
    if intensity_scale is not None and (
        file := next((f for f in files if f.name.lower().endswith(".pcd.bin")), None)
    ):
        raise ValueError(f"{file}: intensity scale: got {intensity_scale:g}, expected none: it is 1 in .pcd.bin")
