"""Columns of boxes of many samples, and ground truth."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES

_VEHICLE = ("vehicle.moving", "vehicle.parked", "vehicle.stopped")
CLASS_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("car", "truck"), _VEHICLE),
    "bus": ("vehicle.moving", "vehicle.stopped", "vehicle.parked"),
    **dict.fromkeys(("trailer", "construction_vehicle"), _VEHICLE),
    "pedestrian": ("pedestrian.moving", "pedestrian.standing", "pedestrian.sitting_lying_down"),
    **dict.fromkeys(("motorcycle", "bicycle"), ("cycle.with_rider", "cycle.without_rider")),
    **dict.fromkeys(("traffic_cone", "barrier"), ()),
}
"""Attributes of each class: first the likeliest one in motion, then the likeliest one at rest."""

LABELS = {name: i for i, name in enumerate(NUSCENES_CLASSES)}  # nuScenes class name -> label
_ATTRIBUTES = sorted({name for names in CLASS_ATTRIBUTES.values() for name in names})
ATTRIBUTE_INDEX = {"": -1, **{name: i for i, name in enumerate(_ATTRIBUTES)}}
"""Attribute name -> index, -1 without an attribute."""

Rows = TypeVar("Rows", bound="Columns")


@dataclasses.dataclass(frozen=True)
class Columns:
    """Arrays of equal length. Row i of all arrays belongs together."""

    def __len__(self) -> int:
        return len(getattr(self, dataclasses.fields(self)[0].name))

    def take(self: Rows, rows: np.ndarray | slice) -> Rows:
        return dataclasses.replace(self, **{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True)
class BoxColumns(Columns):
    """Boxes of many samples in the global frame."""

    sample: np.ndarray  # i32[n]: row of the sample
    label: np.ndarray  # i16[n]: index into the classes of the metric
    translation: np.ndarray  # f64[n, 3]: centre, metres
    size: np.ndarray  # f64[n, 3]: width, length, height, metres
    yaw: np.ndarray  # f64[n]: heading in the ground plane, radians
    velocity: np.ndarray  # f64[n, 2]: m/s, NaN where unknown
    attribute: np.ndarray  # i8[n]: index by ATTRIBUTE_INDEX
    score: np.ndarray  # f64[n]: -1 for truth
    num_points: np.ndarray  # i32[n]: LiDAR and radar points inside, -1 if unknown, as for predictions


_UNKNOWN = {"attribute": -1, "score": -1.0, "num_points": -1}
_WHOLE = {"sample": np.int32, "label": np.int16, "attribute": np.int8, "num_points": np.int32}


def make_columns(**columns: Any) -> BoxColumns:
    """Create columns with the right types. A scalar fills all rows; unknown fields may be left out."""
    arrays = {name: np.asarray(v, _WHOLE.get(name, np.float64)) for name, v in {**_UNKNOWN, **columns}.items()}
    rows = len(arrays["translation"])
    return BoxColumns(**{name: array if array.ndim else np.full(rows, array) for name, array in arrays.items()})


def join(parts: Sequence[BoxColumns]) -> BoxColumns:
    """Concatenate one or more parts in order."""
    names = [field.name for field in dataclasses.fields(BoxColumns)]
    return BoxColumns(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


_NONE = np.zeros((0, 3))
NO_BOXES = make_columns(sample=0, label=0, translation=_NONE, size=_NONE, yaw=0.0, velocity=_NONE[:, :2])


@dataclasses.dataclass(frozen=True)
class GroundTruth:
    """Annotations of samples."""

    tokens: tuple[str, ...]  # names of the samples
    ego_translation: np.ndarray  # f64[samples, 3]: ego vehicle, global frame; origin of the class ranges
    boxes: BoxColumns  # boxes of the metric's classes
    racks: BoxColumns  # bicycle racks of all samples; cycles inside a rack are not evaluated
    rack_axes: np.ndarray  # f64[r, 3, 3]: rotations from rack to global


def heading_yaw(rotation: np.ndarray) -> np.ndarray:
    """Direction of the x axis in the ground plane, f64[n], after rotations f64[n, 4]: w, x, y, z of any positive
    norm.
    """
    w, x, y, z = rotation.T
    return np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
