"""Boxes of many samples as columns, and the truth that they are measured against."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.types import CLASSES

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
    """i8[n]: index into ``types.CLASSES``."""
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
        """Number of boxes."""
        return len(self.sample)

    def take(self, rows: np.ndarray | slice) -> "BoxColumns":
        """Some rows, by index, mask or slice."""
        return BoxColumns(**{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})


def join(parts: Sequence[BoxColumns]) -> BoxColumns:
    """All rows of all parts, in their order; no parts give no rows."""
    parts = [empty_columns(), *parts]
    names = [field.name for field in dataclasses.fields(BoxColumns)]
    return BoxColumns(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def empty_columns() -> BoxColumns:
    """No boxes at all.

    >>> len(empty_columns())
    0
    """
    none = np.zeros(0)
    return BoxColumns(
        sample=none.astype(np.int32),
        label=none.astype(np.int8),
        translation=np.zeros((0, 3)),
        size=np.zeros((0, 3)),
        yaw=none,
        velocity=np.zeros((0, 2)),
        attribute=none.astype(np.int8),
        score=none,
        num_points=none.astype(np.int32),
    )


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


def no_racks() -> Racks:
    """No rack at all.

    >>> len(no_racks().sample)
    0
    """
    return Racks(np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclasses.dataclass(frozen=True)
class GroundTruth:
    """What there is to be found."""

    tokens: tuple[str, ...]
    """The samples."""
    ego_translation: np.ndarray
    """f64[samples, 3]: where the car is, global frame."""
    boxes: BoxColumns
    """Of the ten classes."""
    racks: Racks
    """Bicycle racks."""


def heading_yaw(rotation: np.ndarray) -> np.ndarray:
    """Direction of the rotated x axis in the ground plane, f64[n], for unit quaternions and others alike.

    Args:
        rotation: f64[n, 4]: w, x, y, z.

    >>> heading_yaw(np.array([[2.0, 0, 0, 2]])).round(4).tolist()
    [1.5708]
    """
    w, x, y, z = rotation.T
    return np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)


def rotation_axes(rotation: np.ndarray) -> np.ndarray:
    """Rotation matrices f64[n, 3, 3] on column vectors, of quaternions w, x, y, z of any length but zero.

    >>> rotation_axes(np.array([[0.0, 0, 0, 3]])).tolist()
    [[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]]
    """
    w, x, y, z = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


LABELS = {name: i for i, name in enumerate(CLASSES)}
"""Class name -> label."""
ATTRIBUTE_INDEX = {"": -1, **{name: i for i, name in enumerate(ATTRIBUTES)}}
"""Attribute name -> index."""
