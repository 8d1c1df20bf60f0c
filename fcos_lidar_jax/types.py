"""The containers that travel between the modules: frozen dataclasses of arrays, registered as pytrees.

Axis letters, for the whole package: b batch, n points, r rounds, h rows, w columns, c channels, l locations
(all feature levels, flattened and joined), m boxes (padded), k classes, d detections.

Frame: the LiDAR frame of the current sweep, x right, y forward, z up; metres, radians, seconds.
A box is ``x, y, z, l, w, h, yaw, vx, vy``: gravity centre, length along the heading, yaw counter-clockwise
from +x in [-pi, pi), velocity along the LiDAR axes (NaN where unknown).
"""

import dataclasses
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Bool, Float32, Int32, UInt8, UInt16

CHANNELS = ("x", "y", "z", "range", "azimuth", "inclination", "intensity", "existence", "time_lag")
"""The nine channel types of a range image (paper, section 3.1)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RangeImage:
    """A multi-round range image (paper, sections 3.1 and 3.2).

    >>> import numpy as np
    >>> empty = RangeImage(np.zeros((32, 1086, 9, 5)), np.full((32, 1086, 5), -1), np.int32(0))
    >>> empty.features[:, :, CHANNELS.index("range"), 0].shape  # ranges of the first round
    (32, 1086)
    """

    features: Float32[Array, "*b h w 9 r"]
    """Raw units, channels in the order of :data:`CHANNELS`; zero in all nine where a slot is empty."""
    point_index: Int32[Array, "*b h w r"]  # Row of the input points that fills the slot, -1 where empty.
    num_dropped: Int32[Array, "*b"]
    """Valid input rows that were non-finite, beyond the sensor's limits or outside its field of view."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Batch:
    """One training batch: raw points and padded ground truth.

    >>> import numpy as np
    >>> clouds = np.zeros((2, 4096, 5)), np.zeros((2, 4096), bool)
    >>> batch = Batch(*clouds, np.zeros((2, 32, 9)), np.zeros((2, 32), int), np.zeros((2, 32), bool))
    >>> jax.tree.map(lambda leaf: leaf[0], batch).boxes.shape  # of the first sample
    (32, 9)
    """

    points: Float32[Array, "b n c"]
    """x, y, z, intensity (0-255), time lag (s, 0 for the current sweep), and the laser number as a sixth
    column for sensors whose rows come from it; anything where invalid."""
    valid: Bool[Array, "b n"]  # False for padding.
    boxes: Float32[Array, "b m 9"]  # Boxes as the module describes; anything where invalid.
    labels: Int32[Array, "b m"]  # Index into the classes.
    box_valid: Bool[Array, "b m"]  # False for padding.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PackedBatch:
    """A :class:`Batch` on its way to the device, in fewer bytes, see :mod:`fcos_lidar_jax.packing`.

    Valid rows are in front, in their order, and zeros behind them.

    >>> import numpy as np
    >>> clouds = np.zeros((2, 4096, 3), np.float32), *[np.zeros((2, 4096), np.uint8)] * 2
    >>> truth = np.zeros((2, 32, 9)), np.zeros((2, 32), int), np.zeros((2, 32), bool)
    >>> PackedBatch(*clouds, np.zeros((2, 10), np.float32), None, np.array([17, 4000]), *truth).xyz.nbytes
    98304
    """

    xyz: Float32[Array, "b n 3"]  # Metres.
    intensity: UInt8[Array, "b n"] | Float32[Array, "b n"]  # On the scale 0-255.
    lag: UInt8[Array, "b n"] | UInt16[Array, "b n"] | Float32[Array, "b n"]
    """Index into the sample's ``lags``; the time lag itself, in seconds, where there are none."""
    lags: Float32[Array, "b t"]  # Time lags of each sample, seconds.
    laser: UInt8[Array, "b n"] | Float32[Array, "b n"] | None  # Laser number, for sensors whose rows come from it.
    count: Int32[Array, "b"]  # Valid rows.
    boxes: Float32[Array, "b m 9"]  # This and what follows: as in :class:`Batch`.
    labels: Int32[Array, "b m"]
    box_valid: Bool[Array, "b m"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class HostBatch:
    """A batch on its way to the device, with what is to be reported about it.

    >>> HostBatch(batch=None, counts={"truncated_points": 3}, names=("frame 0", "frame 7")).counts
    {'truncated_points': 3}
    """

    batch: Batch | PackedBatch  # NumPy arrays of this process's rows; on the devices, arrays of the global batch.
    counts: dict[str, int]  # To be recorded beside the metrics, such as ``truncated_points``.
    names: tuple[str, ...]  # Of the samples' frames, for messages.
    misfit: str | None = None  # Why it is not packed where the run's batches are.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Locations:
    """What every location of the feature levels looks at (paper, section 3.4).

    >>> import numpy as np
    >>> from fcos_lidar_jax.locations import ImageLayout, locate
    >>> image = RangeImage(np.ones((32, 128, 9, 1)), np.zeros((32, 128, 1), int), np.int32(0))
    >>> locate(image, ImageLayout(rows=32, columns=128, row_upscale=1)).points.shape
    (5460, 3)
    """

    points: Float32[Array, "*b l 3"]  # First-round point of the location's pixel, metres; zero where empty.
    azimuth_rad: Float32[Array, "*b l"]  # Azimuth of that point; zero where empty.
    cell: Int32[Array, "l"]  # Row-major cell of the sensor's own image (rows not doubled, columns not padded).
    occupied: Bool[Array, "*b l"]  # False where the pixel is empty or a pad column.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outputs:
    """Raw predictions of the network at all locations.

    >>> import numpy as np
    >>> outputs = Outputs(np.zeros((5460, 11)), np.zeros((5460, 10, 10)), np.zeros((5460, 10)))
    >>> outputs.regression[:, :3, 0].shape  # of the first class, the offset to the centre of its box
    (5460, 3)
    """

    logits: Float32[Array, "*b l c"]  # Class logits, k classes and the background last.
    regression: Float32[Array, "*b l 10 k"]
    """Per class: centre offset 3, log size 3, sin and cos of the relative yaw, velocity 2 (equation 2)."""
    iou_logits: Float32[Array, "*b l k"]  # Logit of the predicted IoU, per class.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Targets:
    """The outcome of the assignment for one sample.

    >>> import jax.numpy as jnp
    >>> from fcos_lidar_jax.assignment import assign
    >>> targets = assign(jnp.array([0, 0, -1]), jnp.ones(3), jnp.array([0.9, 0.8, 0.0]), num_boxes=1)
    >>> targets.num_positive.tolist(), targets.positive.tolist()
    ([2], [True, True, False])
    """

    owner: Int32[Array, "*b l"]  # Box whose points the location sees, -1 for none.
    positive: Bool[Array, "*b l"]  # Among the K cheapest locations of its owner.
    num_positive: Int32[Array, "*b m"]  # K of every box (0 for a box without candidates).


class Sums(NamedTuple):
    """The losses of a batch before the division; all of it adds up over micro-batches and devices.

    >>> import jax.numpy as jnp
    >>> Sums(losses={"boxes": {"l1": jnp.float32(3)}}, counts={"boxes": jnp.int32(2)}).means
    {}
    """

    losses: dict[str, dict[str, Array]]
    """Name of the count that divides them -> loss -> its sum, unweighted; ``LossConfig`` has the weights."""
    counts: dict[str, Array]  # Integers, metrics by their names.
    means: dict[str, dict[str, Array]] = {}  # noqa: RUF012
    """Further metrics: name of the count that divides them -> metric -> its sum."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Detections:
    """Final boxes, best first, padded to a fixed count.

    >>> import numpy as np
    >>> none = Detections(np.zeros((5, 9)), np.zeros(5), np.zeros(5, int), np.zeros(5, bool), np.int32(0))
    >>> none.boxes[none.valid].shape
    (0, 9)
    """

    boxes: Float32[Array, "*b d 9"]  # Boxes as the module describes; zero where invalid.
    scores: Float32[Array, "*b d"]  # Class probability times predicted IoU; zero where invalid.
    labels: Int32[Array, "*b d"]  # Index into the classes; zero where invalid.
    valid: Bool[Array, "*b d"]  # False for padding.
    num_dropped: Int32[Array, "*b"]  # As in :class:`RangeImage`.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """All that training carries from step to step: arrays, no functions.

    >>> import numpy as np
    >>> state = TrainState(np.int32(0), {"kernel": np.ones(3)}, {}, (), None, jax.random.key(0))
    >>> len(jax.tree.leaves(state))  # step, kernel, key
    3
    """

    step: Int32[Array, ""]  # Updates done.
    params: Any  # Trainable arrays of the network.
    batch_stats: Any  # Running means and variances of the network's batch norms.
    opt_state: Any  # State of the optax optimizer.
    ema: Any  # Running mean of ``params``, or None.
    key: Any  # The run's random key; every draw is ``fold_in(key, step)``, so a resumed run repeats itself.
