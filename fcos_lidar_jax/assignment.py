"""Which location predicts which box (paper, section 3.4).

A location is a candidate of the box that holds its first-round point. Of the candidates of a box, the K
cheapest become positive; K follows from the boxes they predict. A location has one owner at most, so one sort
by (owner, cost) and a rank do, without a [boxes, locations] matrix.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.geometry import points_in_box
from fcos_lidar_jax.types import Targets


def owners(
    points: Float32[Array | np.ndarray, "n 3"],
    present: Bool[Array | np.ndarray, "n"],
    boxes: Float32[Array | np.ndarray, "m c"],
    box_valid: Bool[Array | np.ndarray, "m"],
) -> Int32[Array, "n"]:
    """The box that owns each point: the smallest that holds it, boundary included.

    Args:
        points, present: metres; False where there is no point.
        boxes, box_valid: ``x, y, z, l, w, h, yaw, ...``, anything where invalid; False for padding.

    Returns:
        box index, -1 for none; equal volumes go to the lower index.

    >>> boxes = jnp.array([[0, 0, 0, 4, 4, 4, 0], [0, 0, 0, 2, 2, 2, 0]], jnp.float32)
    >>> points = jnp.array([[0.5, 0, 0], [1.5, 0, 0], [9, 0, 0]])
    >>> owners(points, jnp.ones(3, bool), boxes, jnp.ones(2, bool)).tolist()
    [1, 0, -1]
    """
    points, present, box_valid = jnp.asarray(points), jnp.asarray(present), jnp.asarray(box_valid)
    solid = jnp.where(box_valid[:, None], boxes, 0.0)
    volume = solid[:, 3] * solid[:, 4] * solid[:, 5]

    def visit(best: tuple[Array, Array], index: Array) -> tuple[tuple[Array, Array], None]:
        least, owner = best
        inside = points_in_box(points, solid[index]) & present & box_valid[index]
        better = inside & (volume[index] < least)
        return (jnp.where(better, volume[index], least), jnp.where(better, index, owner)), None

    start = (jnp.full(points.shape[0], jnp.inf, points.dtype), jnp.full(points.shape[0], -1, jnp.int32))
    return lax.scan(visit, start, jnp.arange(boxes.shape[0], dtype=jnp.int32))[0][1]


def _by_owner(owner: Array, value: Array, num_boxes: int) -> tuple[Array, Array, Array]:
    """Locations sorted by (owner, value, index), the ownerless last: sorted owners, values and indices."""
    group = jnp.where(owner < 0, num_boxes, owner)
    index = lax.iota(jnp.int32, owner.shape[0])
    return lax.sort((group, value, index), num_keys=2, is_stable=True)  # type: ignore[return-value]


def dynamic_k(
    owner: Int32[Array, "l"], iou: Float32[Array, "l"], *, num_boxes: int, top_q: int
) -> Int32[Array, "m"]:
    """K of every box: the rounded sum of its ``top_q`` highest IoUs (x.5 goes up).

    At least 1, at most the number of candidates. ``owner`` is -1 for locations without a box.

    >>> dynamic_k(jnp.array([0, 0, 0, -1]), jnp.array([0.9, 0.6, 0, 0]), num_boxes=2, top_q=20).tolist()
    [2, 0]
    """
    group, falling, _ = _by_owner(owner, -iou, num_boxes)
    edges = jnp.searchsorted(group, jnp.arange(num_boxes + 1, dtype=group.dtype)).astype(jnp.int32)
    first, last = edges[:-1, None], edges[1:, None]
    slot = first + jnp.arange(top_q, dtype=jnp.int32)
    # Gathered to [m, q] and summed along a fixed axis: the rounding cannot depend on the device.
    best = jnp.where(slot < last, -falling[jnp.minimum(slot, owner.shape[0] - 1)], 0.0)
    k = jnp.floor(best.sum(axis=1) + 0.5).astype(jnp.int32)
    count = (last - first)[:, 0]
    return jnp.minimum(jnp.maximum(k, 1), count)


def cheapest(
    owner: Int32[Array, "l"], cost: Float32[Array, "l"], num_positive: Int32[Array, "m"]
) -> Bool[Array, "l"]:
    """The ``num_positive`` cheapest locations of every box; equal costs go to the lower index.

    >>> cheapest(jnp.array([0, 0, -1]), jnp.array([3.0, 2.0, 1.0]), jnp.array([1])).tolist()
    [False, True, False]
    """
    num_boxes, num_locations = num_positive.shape[0], owner.shape[0]
    group, _, index = _by_owner(owner, cost, num_boxes)
    first = jnp.searchsorted(group, jnp.arange(num_boxes + 1, dtype=group.dtype)).astype(jnp.int32)
    rank = lax.iota(jnp.int32, num_locations) - first[group]
    wanted = jnp.concatenate([num_positive, jnp.zeros(1, num_positive.dtype)])
    return jnp.zeros(num_locations, bool).at[index].set(rank < wanted[group])


def assign(
    owner: Int32[Array, "l"],
    classification_cost: Float32[Array, "l"],
    iou: Float32[Array, "l"],
    *,
    num_boxes: int,
    top_q: int = 20,
) -> Targets:
    """Dynamic reassignment of one sample (paper, section 3.4): all levels compete together.

    The cost of a candidate is the cross-entropy of the right class plus one minus the IoU of the decoded box.
    Nothing is differentiated.

    Args:
        owner: box of every location, -1 for none.
        classification_cost: cross-entropy of the owner's class; anything where there is no owner.
        iou: IoU of the decoded box with the owner; likewise.
        num_boxes, top_q: m and Q (static).

    >>> owner = jnp.array([0, 0, -1])
    >>> assign(owner, jnp.array([1.0, 2.0, 0.0]), jnp.array([0.2, 0.3, 0.0]), num_boxes=1).positive.tolist()
    [True, False, False]
    """
    owned = owner >= 0
    iou = jnp.where(owned, lax.stop_gradient(iou), 0.0)
    cost = jnp.where(owned, lax.stop_gradient(classification_cost) + 1 - iou, jnp.inf)
    # A diverging prediction is the last to be chosen, whatever comparison makes of NaN.
    cost = jnp.where(jnp.isnan(cost), jnp.inf, cost)
    with jax.named_scope("assignment"):
        k = dynamic_k(owner, iou, num_boxes=num_boxes, top_q=top_q)
        return Targets(owner=owner, positive=cheapest(owner, cost, k), num_positive=k)
