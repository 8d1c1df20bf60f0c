"""Points of ROS PointCloud2 messages, in the layouts of all drivers."""

from typing import Any

import numpy as np

from fcos_lidar_jax.data.frame import no_points
from fcos_lidar_jax.data.pcd import find_columns
from fcos_lidar_jax.data.point_files import assemble_points
from fcos_lidar_jax.sensors import Sensor

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Datatype of a field -> NumPy's type."""


def parse_point_cloud2(cloud: Any, where: str, sensor: Sensor, *, max_points: int) -> np.ndarray:
    """The points of a message, in the columns of :func:`~fcos_lidar_jax.data.point_files.read_points`.

    ``cloud`` has the message's fields, with ``data`` u8[n]. Clouds of more than ``max_points`` are refused before
    they take memory. ``where`` names the message in errors.
    """
    width, height, step, pitch = cloud.width, cloud.height, cloud.point_step, cloud.row_step
    if width * height > max_points:
        raise ValueError(f"{where}: got {width} x {height} points, expected at most {max_points}")
    pitch = max(pitch, width * step) if height <= 1 else pitch  # some drivers leave it 0 for a single row
    if pitch < width * step:
        raise ValueError(f"{where}: row_step: got {pitch}, expected {width * step}, width x point_step, or more")
    if height and width and len(cloud.data) < (needed := (height - 1) * pitch + width * step):
        sizes = f"got {len(cloud.data)} bytes, expected at least {needed}"
        raise ValueError(f"{where}: data: {sizes} for {height} rows of {width} points of {step}")
    if not width * height:
        return no_points(sensor)
    columns = {}
    for column, dtype, offset in _find_columns(cloud, where):
        values = np.ndarray((height, width), dtype, cloud.data.data, offset, (pitch, step))
        columns[column] = values.reshape(-1)
    return assemble_points(where, sensor, columns)


def _find_columns(cloud: Any, where: str) -> list[tuple[str, np.dtype, int]]:
    """The message's columns, with type and offset within a point."""
    columns, names = [], [field.name for field in cloud.fields]
    places = find_columns(names)
    for axis in "xyz":
        if axis not in places:
            listed = ", ".join(map(repr, names))[:500] or "none"
            raise ValueError(f"{where}: fields: got {listed}, expected one named {axis}")
    places.pop("time_lag", None)  # messages hold single sweeps
    for column, place in places.items():
        name, field = names[place], cloud.fields[place]
        if field.datatype not in _NUMBERS or field.count > 1:
            got = f"{field.count} of datatype {field.datatype}"
            raise ValueError(f"{where}: field {name}: got {got}, expected one number of datatype 1 to 8")
        dtype = np.dtype((">" if cloud.is_bigendian else "<") + _NUMBERS[field.datatype])
        if field.offset + dtype.itemsize > cloud.point_step:
            got, expected = f"{dtype.itemsize} bytes at offset {field.offset}", "a place within point_step"
            raise ValueError(f"{where}: field {name}: got {got}, expected {expected} {cloud.point_step}")
        columns.append((column, dtype, field.offset))
    return columns
