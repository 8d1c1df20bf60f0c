"""Detections as the entries of an official results file: global frame, attributes, plain numbers."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.evaluation.metrics import MAX_BOXES
from fcos_lidar_jax.evaluation.results import LIDAR_META
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.types import CLASSES, Detections

MOVING_MPS = 0.2
"""What is faster moves, for its attribute."""

_MOVING = {
    **dict.fromkeys(("car", "truck", "bus", "trailer", "construction_vehicle"), "vehicle.moving"),
    **dict.fromkeys(("motorcycle", "bicycle"), "cycle.with_rider"),
    "pedestrian": "pedestrian.moving",
}
_STILL = {
    **dict.fromkeys(("car", "truck", "trailer", "construction_vehicle"), "vehicle.parked"),
    **dict.fromkeys(("motorcycle", "bicycle"), "cycle.without_rider"),
    "bus": "vehicle.stopped",
    "pedestrian": "pedestrian.standing",
}


def attribute_of(name: str, speed_mps: float) -> str:
    """The likeliest attribute of a detection, which has none of its own; ``''`` for barriers and cones.

    >>> attribute_of("bus", 0.1), attribute_of("bicycle", 3.0), attribute_of("barrier", 0.0)
    ('vehicle.stopped', 'cycle.with_rider', '')
    """
    return (_MOVING if speed_mps > MOVING_MPS else _STILL).get(name, "")


def result_entries(found: Detections, token: str, sensor_to_global: np.ndarray) -> list[dict[str, Any]]:
    """Detections of one sample as entries of the results file, best first, 500 at most.

    Args:
        found: of one sample, in its LiDAR frame.
        token: of the sample.
        sensor_to_global: f64[4, 4].

    >>> one = np.ones(1, bool)
    >>> car = Detections(np.array([[1.0, 0, 0, 4, 2, 1, 0, 3, 0]]), np.ones(1), np.zeros(1, int), one, np.zeros(0))
    >>> entry = result_entries(car, "a", np.eye(4))[0]
    >>> entry["size"], entry["rotation"], entry["attribute_name"]
    ([2.0, 4.0, 1.0], [1.0, 0.0, 0.0, 0.0], 'vehicle.moving')
    """
    valid = np.flatnonzero(np.asarray(found.valid))[:MAX_BOXES]
    boxes = np.asarray(found.boxes, np.float64)[valid]
    names = [CLASSES[label] for label in np.asarray(found.labels)[valid]]
    scores = np.asarray(found.scores, np.float64)[valid]
    turn = sensor_to_global[:3, :3]
    centres = boxes[:, :3] @ turn.T + sensor_to_global[:3, 3]
    rotations = Rotation.from_matrix(turn) * Rotation.from_rotvec(np.pad(boxes[:, 6:7], ((0, 0), (2, 0))))
    quaternions = rotations.as_quat(canonical=True, scalar_first=True).reshape(-1, 4)
    velocities = np.pad(boxes[:, 7:9], ((0, 0), (0, 1))) @ turn.T
    speeds = np.hypot(boxes[:, 7], boxes[:, 8])
    return [
        {
            "sample_token": token,
            "translation": centres[i].tolist(),
            "size": boxes[i, [4, 3, 5]].tolist(),
            "rotation": quaternions[i].tolist(),
            "velocity": velocities[i, :2].tolist(),
            "detection_name": name,
            "detection_score": float(scores[i]),
            "attribute_name": attribute_of(name, float(speeds[i])),
        }
        for i, name in enumerate(names)
    ]


def write_results(path: str | Path, samples: Iterable[tuple[str, bytes]]) -> None:
    """Write an official results file of a detector that sees the LiDAR alone.

    Args:
        path: JSON file to write.
        samples: every token of the split with its entries as JSON, ``[]`` where nothing was found.
    """

    def write(file: Path) -> None:
        with file.open("wb") as stream:
            stream.write(b'{"meta": %s, "results": {' % json.dumps(LIDAR_META).encode())
            for i, (token, entries) in enumerate(samples):
                stream.write(b"%s\n%s: %s" % (b"," if i else b"", json.dumps(token).encode(), entries))
            stream.write(b"\n}}\n")

    write_beside(path, write)
