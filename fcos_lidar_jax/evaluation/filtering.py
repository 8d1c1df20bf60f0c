"""Which boxes the benchmark looks at: near enough, with points, and not in a bicycle rack."""

import numpy as np

from fcos_lidar_jax.evaluation.boxes import BoxColumns, Racks
from fcos_lidar_jax.types import CLASSES

CLASS_RANGE_M = {
    "car": 50,
    "truck": 50,
    "bus": 50,
    "trailer": 50,
    "construction_vehicle": 50,
    "pedestrian": 40,
    "motorcycle": 40,
    "bicycle": 40,
    "traffic_cone": 30,
    "barrier": 30,
}
"""Boxes count up to here, in the ground plane, from the car and not from its sensor."""

_RANGES = np.array([CLASS_RANGE_M[name] for name in CLASSES], float)
_CYCLES = [CLASSES.index("bicycle"), CLASSES.index("motorcycle")]


def filter_boxes(boxes: BoxColumns, ego_translation: np.ndarray, racks: Racks) -> BoxColumns:
    """The boxes that are evaluated, in their order.

    Left out is what lies at or beyond its class's range, what holds not a single LiDAR or radar point, and
    bicycles and motorcycles whose centre is in a bicycle rack.

    Args:
        boxes: truth or predictions.
        ego_translation: f64[samples, 3], global frame.
        racks: of all samples.
    """
    offset = boxes.translation[:, :2] - ego_translation[boxes.sample, :2]
    near = np.sqrt((offset**2).sum(axis=1)) < _RANGES[boxes.label]
    boxes = boxes.take(near & (boxes.num_points != 0))
    return boxes.take(~in_rack(boxes, racks))


def in_rack(boxes: BoxColumns, racks: Racks) -> np.ndarray:
    """bool[n]: a bicycle or motorcycle with its centre in a rack of its sample, boundary included."""
    inside = np.zeros(len(boxes), bool)
    cycles = np.flatnonzero(np.isin(boxes.label, _CYCLES) & np.isin(boxes.sample, racks.sample))
    order = cycles[np.argsort(boxes.sample[cycles], kind="stable")]
    sample = boxes.sample[order]
    for i in range(len(racks.sample)):
        first, last = np.searchsorted(sample, racks.sample[i]), np.searchsorted(sample, racks.sample[i], "right")
        rows = order[first:last]
        local = (boxes.translation[rows] - racks.translation[i]) @ racks.axes[i]
        half = racks.size[i][[1, 0, 2]] / 2
        inside[rows] |= (np.abs(local) <= half).all(axis=1)
    return inside
