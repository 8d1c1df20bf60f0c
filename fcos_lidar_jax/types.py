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
"""The nine channel types of a range image (paper, section 3.1)."""
BOX = "x, y, z, l, w, h, yaw, ..."
"""Columns of boxes that functions need; more may follow."""
ORIENTED = "x, y, z, l, w, h, cos yaw, sin yaw"


def check_columns(name: str, array: Array | np.ndarray, columns: str) -> None:
    """Refuse arrays without the expected columns: JAX clamps indices, so results would be wrong without an error.

    ``columns`` are the names of the last axis; ``"..."`` at the end allows more. ``name`` names the array.

    Raises:
        ValueError: too few or too many columns.

    >>> check_columns("box", np.zeros(5), "x, y, z, l, w, h, yaw, ...")
    Traceback (most recent call last):
    ValueError: box: got shape (5,), expected columns x, y, z, l, w, h, yaw, ...
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

    >>> check_rows(2, scores=np.zeros((2, 1)))
    Traceback (most recent call last):
    ValueError: scores: got shape (2, 1), expected (2,)
    """
    for name, array in arrays.items():
        shape = np.shape(array)
        if len(shape) != axes or shape[0] != number:
            raise ValueError(f"{name}: got shape {shape}, expected ({number},{' ...' * (axes - 1)})")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RangeImage:
    """A multi-round range image (paper, sections 3.1 and 3.2).

    >>> empty = RangeImage(np.zeros((32, 1086, 9, 5)), np.full((32, 1086, 5), -1), np.int32(0))
    >>> empty.features[:, :, CHANNELS.index("range"), 0].shape  # ranges of the first round
    (32, 1086)
    """

    features: Float32[Array, "*b h w 9 r"]
    """Channels in the order of :data:`CHANNELS`, in raw units; all nine are zero in empty slots."""
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
    """A batch before and after transfer to the device, with information for logs and messages.

    >>> HostBatch(batch=None, counts={"truncated_points": 3}, names=("frame 0", "frame 7")).counts
    {'truncated_points': 3}
    """

    batch: Batch  # NumPy rows of this process; after transfer, arrays of the global batch.
    counts: dict[str, int]  # Logged with the metrics, such as ``truncated_points``.
    names: tuple[str, ...]  # Frame names of the samples, for messages.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Locations:
    """Point and pixel of each location of the feature levels (paper, section 3.4).

    >>> from fcos_lidar_jax.locations import ImageLayout, locate
    >>> image = RangeImage(np.ones((32, 128, 9, 1)), np.zeros((32, 128, 1), int), np.int32(0))
    >>> locate(image, ImageLayout(rows=32, columns=128, row_upscale=1)).points.shape
    (5460, 3)
    """

    points: Float32[Array, "*b l 3"]  # First-round point of the location's pixel, metres; zero where empty.
    azimuth_rad: Float32[Array, "*b l"]  # Azimuth of that point; zero where empty.
    cell: Int32[Array, "l"]  # Row-major cell of the sensor's image, before rows are repeated and columns padded.
    occupied: Bool[Array, "*b l"]  # False where the pixel is empty or padding.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outputs:
    """Raw predictions of the network at all locations.

    >>> outputs = Outputs(np.zeros((5460, 11)), np.zeros((5460, 10, 10)), np.zeros((5460, 10)))
    >>> outputs.regression[:, :3, 0].shape  # centre offsets of the first class
    (5460, 3)
    """

    logits: Float32[Array, "*b l c"]  # Class logits: k classes, then the background.
    regression: Float32[Array, "*b l 10 k"]
    """Per class: centre offset 3, log size 3, sin and cos of the relative yaw, velocity 2 (equation 2)."""
    iou_logits: Float32[Array, "*b l k"]  # Logit of the predicted IoU, per class.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Targets:
    """Result of the assignment of one sample.

    >>> import jax.numpy as jnp
    >>> from fcos_lidar_jax.assignment import assign
    >>> targets = assign(jnp.array([0, 0, -1]), jnp.ones(3), jnp.array([0.9, 0.8, 0.0]), num_boxes=1)
    >>> targets.num_positive.tolist(), targets.positive.tolist()
    ([2], [True, True, False])
    """

    owner: Int32[Array, "*b l"]  # Box that contains the location's point, -1 where no box does.
    positive: Bool[Array, "*b l"]  # True for the K cheapest locations of each owner.
    num_positive: Int32[Array, "*b m"]  # K of each box (0 for a box without candidates).


class Sums(NamedTuple):
    """The losses of a batch before the division. All fields are sums, which add up over micro-batches and devices.

    >>> import jax.numpy as jnp
    >>> Sums(losses={"boxes": {"l1": jnp.float32(3)}}, counts={"boxes": jnp.int32(2)}).means
    {}
    """

    losses: dict[str, dict[str, Array]]
    """Name of the count that divides them -> loss -> its sum, unweighted; ``LossConfig`` has the weights."""
    counts: dict[str, Array]  # Integer counts by name; they are metrics, too.
    means: dict[str, dict[str, Array]] = {}  # noqa: RUF012
    """Further metrics: name of the count that divides them -> metric -> its sum."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Detections:
    """Final boxes, best first, padded to a fixed count.

    >>> none = Detections(np.zeros((5, 9)), np.zeros(5), np.zeros(5, int), np.zeros(5, bool), np.int32(0))
    >>> none.boxes[none.valid].shape
    (0, 9)
    """

    boxes: Float32[Array, "*b d 9"]  # Boxes, see the module docstring; zero where invalid.
    scores: Float32[Array, "*b d"]  # Class probability times predicted IoU; zero where invalid.
    labels: Int32[Array, "*b d"]  # Class index; zero where invalid.
    valid: Bool[Array, "*b d"]  # False for padding.
    num_dropped: Int32[Array, "*b"]  # See :class:`RangeImage`.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """State carried from step to step: arrays only, no functions.

    >>> state = TrainState(np.int32(0), {"kernel": np.ones(3)}, {}, (), None, jax.random.key(0))
    >>> len(jax.tree.leaves(state))  # step, kernel, key
    3
    """

    step: Int32[Array, ""]  # Number of completed updates.
    params: Any  # Trainable arrays of the network.
    batch_stats: Any  # Running means and variances of the network's batch norms.
    opt_state: Any  # State of the optax optimizer.
    ema: Any  # Running mean of ``params``, or None.
    key: Any  # Random key of the run; each step uses ``fold_in(key, step)``, so that a resumed run repeats itself.
