"""One annotated keyframe: a point file with boxes in a JSON file beside it."""

from pathlib import Path

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import WHOLE_SWEEP, CloudReading
from fcos_lidar_jax.data.box_geometry import LIMITS, check_boxes
from fcos_lidar_jax.data.frame import Frame, drop_close
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.sensors import Sensor


def read_keyframe(folder: Path, sensor: Sensor, number: int = 0, reading: CloudReading = WHOLE_SWEEP) -> Frame:
    """Read a folder's keyframe, or a list's keyframe by its number, with the boxes of the ten nuScenes classes.

    ``boxes.json`` is ``{"lidar_file": NAME, "boxes": [{"class", "x", "y", "z", "l", "w", "h", "yaw", "vx", "vy",
    "num_lidar_pts"}]}`` in the LiDAR frame, or a list of such records. The count may also be called
    "num_lidar_pts_at_key_frame". Unknown velocities are null and become NaN. Other classes are dropped.

    Raises:
        ValueError: with the file and the field.
    """
    file = folder / "boxes.json"
    record = read_json(file, what="the boxes of a keyframe")
    try:
        record = record[number] if isinstance(record, list) else record
        rows = [b for b in record["boxes"] if b["class"] in NUSCENES_CLASSES]
        boxes = np.array([[np.nan if b[k] is None else float(b[k]) for k in LIMITS] for b in rows])
        count = "num_lidar_pts" if all("num_lidar_pts" in b for b in rows) else "num_lidar_pts_at_key_frame"
        counts = np.array([int(b[count]) for b in rows], np.int32)
        cloud = file.parent / str(record["lidar_file"])
    except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{file}: a field is missing or of another kind: {error}") from None
    boxes = boxes.reshape(-1, 9)
    check_boxes(boxes, lambda i: f"{file}: box {i} of the ten classes")
    labels = np.array([NUSCENES_CLASSES.index(b["class"]) for b in rows], np.int32)
    try:
        points, num_close = drop_close(read_points(cloud, sensor), sensor, reading)
    except ValueError as error:
        raise ValueError(f"{file}: lidar_file: {error}") from None
    return Frame(points, boxes.astype(np.float32), labels, counts, num_close)
