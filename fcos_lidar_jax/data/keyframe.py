"""One annotated keyframe: a cloud with its boxes in a JSON file beside it."""

import json
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.point_files import PointFileError, read_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CLASSES

_NUMBERS = ("x", "y", "z", "l", "w", "h", "yaw", "vx", "vy")


def read_keyframe(folder: str | Path, sensor: Sensor) -> Frame:
    """The keyframe of a folder, with the boxes of the ten classes.

    ``boxes.json`` is ``{"lidar_file": NAME, "boxes": [{"class", "x", "y", "z", "l", "w", "h", "yaw", "vx", "vy",
    "num_lidar_pts"}]}`` in the LiDAR frame; an unknown velocity is null and becomes NaN; other classes are
    left out.

    Args:
        folder: holds ``boxes.json`` and the point file.
        sensor: whose points they are.

    Raises:
        PointFileError: naming the file and the field.
    """
    file = Path(folder) / "boxes.json"
    if not file.is_file():
        raise PointFileError(f"{file}: no such file, expected the boxes of a keyframe")
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise PointFileError(f"{file}: not JSON: {error}") from None
    try:
        rows = [b for b in record["boxes"] if b["class"] in CLASSES]
        boxes = np.array([[np.nan if b[k] is None else float(b[k]) for k in _NUMBERS] for b in rows], np.float32)
        counts = np.array([int(b["num_lidar_pts"]) for b in rows], np.int32)
        cloud = file.parent / str(record["lidar_file"])
    except (KeyError, TypeError, ValueError) as error:
        raise PointFileError(f"{file}: a field is missing or of another kind: {error}") from None
    labels = np.array([CLASSES.index(b["class"]) for b in rows], np.int32)
    return Frame(read_points(cloud, sensor), boxes.reshape(-1, 9), labels, counts)
