"""Containers shared by the modules: frozen dataclasses of arrays, registered as pytrees.

Axis letters of the whole package: b batch, n points, r rounds, h rows, w columns, c channels, l locations (all
feature levels, flattened and concatenated), m boxes (padded), k classes, d detections.

Frame: the LiDAR frame of the current sweep, x right, y forward, z up; metres, radians, seconds.
A box is ``x, y, z, l, w, h, yaw, vx, vy``: centre of gravity, length along the heading, yaw counter-clockwise from
+x in [-pi, pi), velocity along the LiDAR axes (NaN where unknown).
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float32, Int32

CHANNELS = ("x", "y", "z", "range", "azimuth", "inclination", "intensity", "existence", "time_lag")
"""The channel types of a range image (paper, section 3.1). Detectors may add their own at the end."""
BOX = "x, y, z, l, w, h, yaw, ..."
"""Columns of boxes that functions need; more may follow."""
ORIENTED = "x, y, z, l, w, h, cos yaw, sin yaw"


def check_columns(name: str, array: Array | np.ndarray, columns: str) -> None:
    """Refuse arrays without the expected columns: JAX clamps indices, so results would be wrong without an error.

    ``columns`` are the names of the last axis; ``"..."`` at the end allows more. ``name`` names the array.

    Raises:
        ValueError: too few or too many columns.
    """
    names = columns.split(", ")
    number, found = len(names) - (names[-1] == "..."), array.shape[-1] if array.shape else 0
    fits = found == number or (found > number and names[-1] == "...")
    if not fits:
        raise ValueError(f"{name}: got shape {array.shape}, expected columns {columns}")


def check_rows(number: int, *, axes: int = 1, **arrays: Any) -> None:
    """Refuse arrays of another length, which JAX would broadcast or clamp to wrong results without an error.

    Raises:
        ValueError: an array has another length than ``number``, or another number of ``axes``.
    """
    for name, array in arrays.items():
        shape = np.shape(array)
        if len(shape) != axes or shape[0] != number:
            raise ValueError(f"{name}: got shape {shape}, expected ({number},{' ...' * (axes - 1)})")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RangeImage:
    """A multi-round range image (paper, sections 3.1 and 3.2)."""

    features: Float32[Array, "*b h w c r"]
    """Channels in the order of :data:`CHANNELS`, in raw units; all are zero in empty slots."""
    point_index: Int32[Array, "*b h w r"]  # Row of the input point in the slot, -1 where empty.
    num_dropped: Int32[Array, "*b"]
    """Valid input rows that were non-finite, beyond the sensor's limits or outside its field of view."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Batch:
    """One training batch: raw points and padded ground truth.

    Attributes:
        points: f32[b, n, c]: x, y, z, intensity (0-255), time lag (s, 0 for the current sweep), and the laser
            number as a sixth column for sensors with ``row_source="laser"``; arbitrary where invalid.
        valid: bool[b, n]: False for padding.
        boxes: f32[b, m, 9]: x, y, z, l, w, h, yaw, vx, vy; NaN velocity where unknown; arbitrary where invalid.
        labels: i32[b, m]: class index.
        box_valid: bool[b, m]: False for padding.

    >>> clouds = np.zeros((2, 4096, 5)), np.zeros((2, 4096), bool)
    >>> batch = Batch(*clouds, np.zeros((2, 32, 9)), np.zeros((2, 32), int), np.zeros((2, 32), bool))
    >>> jax.tree.map(lambda leaf: leaf[0], batch).boxes.shape  # of the first sample
    (32, 9)
    """

    points: Float32[Array, "b n c"]
    valid: Bool[Array, "b n"]
    boxes: Float32[Array, "b m 9"]
    labels: Int32[Array, "b m"]
    box_valid: Bool[Array, "b m"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HostBatch:
    """A batch before and after transfer to the device, with information for logs and messages."""

    batch: Batch  # NumPy rows of this process; after transfer, arrays of the global batch.
    counts: dict[str, int]  # Logged with the metrics, such as ``truncated_points``.
    names: tuple[str, ...]  # Frame names of the samples, for messages.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Locations:
    """Point and pixel of each location of the feature levels (paper, section 3.4)."""

    points: Float32[Array, "*b l 3"]  # First-round point of the location's pixel, metres; zero where empty.
    azimuth_rad: Float32[Array, "*b l"]  # Azimuth of that point; zero where empty.
    cell: Int32[Array, "l"]  # Row-major cell of the sensor's image, before rows are repeated and columns padded.
    occupied: Bool[Array, "*b l"]  # False where the pixel is empty or padding.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outputs:
    """Raw predictions of the network at all locations."""

    logits: Float32[Array, "*b l c"]  # Class logits: k classes, then the background.
    regression: Float32[Array, "*b l 10 k"]
    """Per class: centre offset 3, log size 3, sin and cos of the relative yaw, velocity 2 (equation 2)."""
    iou_logits: Float32[Array, "*b l k"]  # Logit of the predicted IoU, per class.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Targets:
    """Result of the assignment of one sample."""

    owner: Int32[Array, "*b l"]  # Box that contains the location's point, -1 where no box does.
    positive: Bool[Array, "*b l"]  # True for the K cheapest locations of each owner.
    num_positive: Int32[Array, "*b m"]  # K of each box (0 for a box without candidates).


class Sums(NamedTuple):
    """The losses of a batch before the division: sums, which add up over micro-batches and devices."""

    losses: dict[str, dict[str, Array]]
    """Name of the count that divides them -> loss -> its sum, unweighted; ``LossConfig`` has the weights."""
    counts: dict[str, Array]  # Integer counts by name; they are metrics, too.
    means: dict[str, dict[str, Array]] = {}  # noqa: RUF012
    """Further metrics: name of the count that divides them -> metric -> its sum."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Detections:
    """Final boxes, best first, padded to a fixed count."""

    boxes: Float32[Array, "*b d 9"]  # Boxes, see the module docstring; zero where invalid.
    scores: Float32[Array, "*b d"]  # Of class and IoU branches, or of the second look; zero where invalid.
    labels: Int32[Array, "*b d"]  # Class index; zero where invalid.
    valid: Bool[Array, "*b d"]  # False for padding.
    num_dropped: Int32[Array, "*b"]  # See :class:`RangeImage`.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """State carried from step to step: arrays only, no functions."""

    step: Int32[Array, ""]  # Number of completed updates.
    params: Any  # Trainable arrays of the network.
    batch_stats: Any  # Running means and variances of the network's batch norms.
    opt_state: Any  # State of the optax optimizer.
    ema: Any  # Running mean of ``params``, or None.
    key: Any  # Random key of the run; each step uses ``fold_in(key, step)``, so that a resumed run repeats itself.
