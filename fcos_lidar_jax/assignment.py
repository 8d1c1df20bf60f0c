"""Which location predicts which box (paper, section 3.4).

A location is a candidate for the box that contains its first-round point. The K cheapest candidates of each box
become positive; K depends on the boxes that the candidates predict. Because a location has at most one owner, one
sort by (owner, cost) ranks all candidates without a [boxes, locations] matrix.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.forms import in_form, search
from fcos_lidar_jax.geometry import points_in_box
from fcos_lidar_jax.types import Targets, check_rows


def owners(
    points: Float32[Array | np.ndarray, "n 3"],
    present: Bool[Array | np.ndarray, "n"],
    boxes: Float32[Array | np.ndarray, "m c"],
    box_valid: Bool[Array | np.ndarray, "m"],
    *,
    form: Literal["loop", "reduction"] | None = None,
) -> Int32[Array, "n"]:
    """Index of the smallest box that contains each point, boundary included.

    Args:
        points, present: coordinates in metres; False where there is no point.
        boxes, box_valid: ``x, y, z, l, w, h, yaw, ...``, arbitrary where invalid; False for padding. A box with
            NaN contains no point.
        form: ``"loop"`` over the boxes or one ``"reduction"`` over all pairs, with equal results (static). None
            selects the loop on CPUs and the reduction elsewhere, when the program runs.

    Returns:
        box index, or -1 where no box contains the point; the lower index wins among equal volumes.

    Raises:
        ValueError: at trace time, if ``present`` or ``box_valid`` has another length than its array.

    >>> boxes = jnp.array([[0, 0, 0, 4, 4, 4, 0], [0, 0, 0, 2, 2, 2, 0]], jnp.float32)
    >>> points = jnp.array([[0.5, 0, 0], [1.5, 0, 0], [9, 0, 0]])
    >>> owners(points, jnp.ones(3, bool), boxes, jnp.ones(2, bool)).tolist()
    [1, 0, -1]
    """
    check_rows(len(points), present=present)
    check_rows(len(boxes), box_valid=box_valid)
    if not len(boxes):
        return jnp.full(len(points), -1, jnp.int32)
    points, present, box_valid = jnp.asarray(points), jnp.asarray(present), jnp.asarray(box_valid)
    boxes = jnp.where(box_valid[:, None], boxes, 0.0)
    forms = {"loop": _owners_by_box, "reduction": _owners_by_rank}
    return in_form(form, forms, points, present, boxes, box_valid, cpu="loop", default="reduction")


def _volume(boxes: Array) -> Array:
    return boxes[:, 3] * boxes[:, 4] * boxes[:, 5]


def _owners_by_box(points: Array, present: Array, boxes: Array, box_valid: Array) -> Array:
    """Visit the boxes one at a time: fast where memory bandwidth is the limit."""
    volume = _volume(boxes)

    def visit(best: tuple[Array, Array], index: Array) -> tuple[tuple[Array, Array], None]:
        smallest, owner = best
        inside = points_in_box(points, boxes[index]) & present & box_valid[index]
        better = inside & (volume[index] < smallest)
        return (jnp.where(better, volume[index], smallest), jnp.where(better, index, owner)), None

    start = (jnp.full(points.shape[0], jnp.inf, points.dtype), jnp.full(points.shape[0], -1, jnp.int32))
    return lax.scan(visit, start, jnp.arange(boxes.shape[0], dtype=jnp.int32))[0][1]


def _owners_by_rank(points: Array, present: Array, boxes: Array, box_valid: Array) -> Array:
    """Reduce over [points, boxes], sorted by volume; XLA fuses the matrix away."""
    num_boxes, volume = boxes.shape[0], _volume(boxes)
    order = jnp.argsort(volume, stable=True).astype(jnp.int32)
    boxes, eligible = boxes[order], (box_valid & (volume < jnp.inf))[order]
    inside = points_in_box(points[:, None], boxes) & present[:, None] & eligible
    rank = jnp.where(inside, lax.iota(jnp.int32, num_boxes), num_boxes).min(axis=1, initial=num_boxes)
    return jnp.append(order, jnp.int32(-1))[rank]


def _edges(group: Array, num_boxes: int) -> Array:
    """Start index of each group in sorted groups, i32[num_boxes + 1]."""
    return search(group, lax.iota(group.dtype, num_boxes + 1)).astype(jnp.int32)


def _by_owner(owner: Array, value: Array, num_boxes: int) -> tuple[Array, Array, Array]:
    """Sort locations by (owner, value, index), locations without an owner last: owners, values, indices."""
    group = jnp.where(owner < 0, num_boxes, owner)
    index = lax.iota(jnp.int32, owner.shape[0])
    return lax.sort((group, value, index), num_keys=2, is_stable=True)  # type: ignore[return-value]


def dynamic_k(
    owner: Int32[Array, "l"], iou: Float32[Array, "l"], *, num_boxes: int, top_q: int
) -> Int32[Array, "m"]:
    """K of each box: the sum of its ``top_q`` highest IoUs, rounded half up.

    K is at least 1 and at most the number of candidates. ``owner`` is -1 for locations without a box.
    ``num_boxes`` and ``top_q`` are static.

    >>> dynamic_k(jnp.array([0, 0, 0, -1]), jnp.array([0.9, 0.6, 0, 0]), num_boxes=2, top_q=20).tolist()
    [2, 0]
    """
    if not len(owner):
        return jnp.zeros(num_boxes, jnp.int32)
    group, negative_iou, _ = _by_owner(owner, -iou, num_boxes)
    edges = _edges(group, num_boxes)
    first, end = edges[:-1, None], edges[1:, None]
    slot = first + jnp.arange(top_q, dtype=jnp.int32)
    # Gather to [m, q] and sum along a fixed axis, so that rounding does not depend on the device.
    best = jnp.where(slot < end, -negative_iou[jnp.minimum(slot, owner.shape[0] - 1)], 0.0)
    k = jnp.floor(best.sum(axis=1) + 0.5).astype(jnp.int32)
    return jnp.minimum(jnp.maximum(k, 1), (end - first)[:, 0])


def cheapest(
    owner: Int32[Array, "l"], cost: Float32[Array, "l"], num_positive: Int32[Array, "m"]
) -> Bool[Array, "l"]:
    """Mask of the ``num_positive`` cheapest locations of each box; the lower index wins among equal costs.

    >>> cheapest(jnp.array([0, 0, -1]), jnp.array([3.0, 2.0, 1.0]), jnp.array([1])).tolist()
    [False, True, False]
    """
    num_boxes, num_locations = num_positive.shape[0], owner.shape[0]
    group, _, index = _by_owner(owner, cost, num_boxes)
    rank = lax.iota(jnp.int32, num_locations) - _edges(group, num_boxes)[group]
    limit = jnp.append(num_positive, jnp.zeros(1, num_positive.dtype))
    return jnp.zeros(num_locations, bool).at[index].set(rank < limit[group])


def assign(
    owner: Int32[Array, "l"],
    classification_cost: Float32[Array, "l"],
    iou: Float32[Array, "l"],
    *,
    num_boxes: int,
    top_q: int = 20,
) -> Targets:
    """Assign the locations of one sample dynamically (paper, section 3.4); all levels compete with each other.

    The cost of a candidate is the cross-entropy of the true class plus one minus the IoU of the decoded box.
    No gradient flows through the assignment. A location with NaN ranks last, and a NaN among the Q highest IoUs
    makes K 1.

    Args:
        owner: box of each location, -1 where there is no box.
        classification_cost: cross-entropy of the owner's class; arbitrary where there is no owner.
        iou: IoU of the decoded box with the owner; arbitrary where there is no owner.
        num_boxes, top_q: m and Q (static).

    Raises:
        ValueError: at trace time, if the arrays have different lengths.

    >>> owner = jnp.array([0, 0, -1])
    >>> assign(owner, jnp.array([1.0, 2.0, 0.0]), jnp.array([0.2, 0.3, 0.0]), num_boxes=1).positive.tolist()
    [True, False, False]
    """
    check_rows(len(owner), owner=owner, classification_cost=classification_cost, iou=iou)
    owned = owner >= 0
    iou = jnp.where(owned, lax.stop_gradient(iou), 0.0)
    cost = jnp.where(owned, lax.stop_gradient(classification_cost) + 1 - iou, jnp.inf)
    # Rank diverged predictions last: comparisons with NaN would order them arbitrarily.
    cost = jnp.where(jnp.isnan(cost), jnp.inf, cost)
    with jax.named_scope("assignment"):
        k = dynamic_k(owner, iou, num_boxes=num_boxes, top_q=top_q)
        return Targets(owner=owner, positive=cheapest(owner, cost, k), num_positive=k)
