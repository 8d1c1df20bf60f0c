"""Boxes of many samples as columns, and the truth that they are measured against."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES

_VEHICLE = ("vehicle.moving", "vehicle.parked", "vehicle.stopped")
_CYCLE = ("cycle.with_rider", "cycle.without_rider")
CLASS_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "car": _VEHICLE,
    "truck": _VEHICLE,
    "bus": _VEHICLE,
    "trailer": _VEHICLE,
    "construction_vehicle": _VEHICLE,
    "pedestrian": ("pedestrian.moving", "pedestrian.sitting_lying_down", "pedestrian.standing"),
    "motorcycle": _CYCLE,
    "bicycle": _CYCLE,
    "traffic_cone": (),
    "barrier": (),
}
"""The attributes that a box of each class may have."""

ATTRIBUTES = tuple(sorted({name for names in CLASS_ATTRIBUTES.values() for name in names}))
"""All of them; columns hold their index, -1 for none."""

UNKNOWN_POINTS = -1
"""Number of points of a box that nobody counted, such as a prediction."""


@dataclasses.dataclass(frozen=True)
class BoxColumns:
    """Boxes of many samples in the global frame: row i of every column is one box."""

    sample: np.ndarray
    """i32[n]: row of the sample."""
    label: np.ndarray
    """i16[n]: index into the classes of the metric."""
    translation: np.ndarray
    """f64[n, 3]: centre, metres."""
    size: np.ndarray
    """f64[n, 3]: width, length, height, metres."""
    yaw: np.ndarray
    """f64[n]: direction of the heading axis in the ground plane, radians."""
    velocity: np.ndarray
    """f64[n, 2]: m/s, NaN where unknown."""
    attribute: np.ndarray
    """i8[n]: index into :data:`ATTRIBUTES`, -1 for none."""
    score: np.ndarray
    """f64[n]: -1 for truth."""
    num_points: np.ndarray
    """i32[n]: LiDAR and radar points inside, :data:`UNKNOWN_POINTS` for a prediction."""

    def __len__(self) -> int:
        return len(self.sample)

    def take(self, rows: np.ndarray | slice) -> "BoxColumns":
        """Some rows, by index, mask or slice."""
        return BoxColumns(**{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})


_UNKNOWN = {"attribute": -1, "score": -1.0, "num_points": UNKNOWN_POINTS}
_WHOLE = {"sample": np.int32, "label": np.int16, "attribute": np.int8, "num_points": np.int32}


def make_columns(**columns: Any) -> BoxColumns:
    """Columns in their number types; a single value stands for all rows.

    Args:
        columns: fields of :class:`BoxColumns`; attribute, score and number of points are unknown where left out.

    >>> no_box = np.zeros((0, 3))
    >>> len(make_columns(sample=0, label=0, translation=no_box, size=no_box, yaw=0.0, velocity=no_box[:, :2]))
    0
    """
    arrays = {name: np.asarray(v, _WHOLE.get(name, np.float64)) for name, v in {**_UNKNOWN, **columns}.items()}
    rows = len(arrays["translation"])
    return BoxColumns(**{name: array if array.ndim else np.full(rows, array) for name, array in arrays.items()})


@dataclasses.dataclass(frozen=True)
class Racks:
    """Bicycle racks: what stands in one is not evaluated."""

    sample: np.ndarray
    """i32[r]: row of the sample."""
    translation: np.ndarray
    """f64[r, 3]: centre, global frame."""
    size: np.ndarray
    """f64[r, 3]: width, length, height."""
    axes: np.ndarray
    """f64[r, 3, 3]: rack to global."""


NO_BOXES = make_columns(
    sample=0, label=0, translation=np.zeros((0, 3)), size=np.zeros((0, 3)), yaw=0.0, velocity=np.zeros((0, 2))
)
"""No box at all."""
NO_RACKS = Racks(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
"""No rack at all."""
Rows = TypeVar("Rows", BoxColumns, Racks)


def join(parts: Sequence[Rows]) -> Rows:
    """All rows of all parts, at least one, in their order."""
    names = [field.name for field in dataclasses.fields(parts[0])]
    return type(parts[0])(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclasses.dataclass(frozen=True)
class GroundTruth:
    """The annotations of some samples."""

    tokens: tuple[str, ...]
    """Names of the samples."""
    ego_translation: np.ndarray
    """f64[samples, 3]: the ego vehicle, global frame; class ranges count from here."""
    boxes: BoxColumns
    """Of the metric's classes."""
    racks: Racks
    """Bicycle racks of all samples."""


def heading_yaw(rotation: np.ndarray) -> np.ndarray:
    """Direction of the rotated x axis in the ground plane, f64[n], for unit quaternions and others alike.

    Args:
        rotation: f64[n, 4]: w, x, y, z.

    >>> heading_yaw(np.array([[2.0, 0, 0, 2]])).round(4).tolist()
    [1.5708]
    """
    w, x, y, z = rotation.T
    return np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)


LABELS = {name: i for i, name in enumerate(NUSCENES_CLASSES)}
"""nuScenes class name -> label."""
ATTRIBUTE_INDEX = {"": -1, **{name: i for i, name in enumerate(ATTRIBUTES)}}
"""Attribute name -> index."""
