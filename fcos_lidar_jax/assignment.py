"""Which location predicts which box (paper, section 3.4).

A location is a candidate of the box that holds its first-round point. Of the candidates of a box, the K
cheapest become positive; K follows from the boxes they predict. A location has one owner at most, so one sort
by (owner, cost) and a rank do, without a [boxes, locations] matrix.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.forms import in_form, search
from fcos_lidar_jax.geometry import points_in_box
from fcos_lidar_jax.types import Targets


def owners(
    points: Float32[Array | np.ndarray, "n 3"],
    present: Bool[Array | np.ndarray, "n"],
    boxes: Float32[Array | np.ndarray, "m c"],
    box_valid: Bool[Array | np.ndarray, "m"],
    *,
    form: Literal["loop", "reduction"] | None = None,
) -> Int32[Array, "n"]:
    """The box that owns each point: the smallest that holds it, boundary included.

    Args:
        points, present: metres; False where there is no point.
        boxes, box_valid: ``x, y, z, l, w, h, yaw, ...``, anything where invalid; False for padding.
        form: a loop over the boxes, or one reduction over all pairs; the same result (static). None: the loop on
            a CPU, the reduction elsewhere, decided where the program runs.

    Returns:
        box index, -1 for none; equal volumes go to the lower index.

    >>> boxes = jnp.array([[0, 0, 0, 4, 4, 4, 0], [0, 0, 0, 2, 2, 2, 0]], jnp.float32)
    >>> points = jnp.array([[0.5, 0, 0], [1.5, 0, 0], [9, 0, 0]])
    >>> owners(points, jnp.ones(3, bool), boxes, jnp.ones(2, bool)).tolist()
    [1, 0, -1]
    """
    solid = jnp.where(jnp.asarray(box_valid)[:, None], boxes, 0.0)
    given = jnp.asarray(points), jnp.asarray(present), solid, jnp.asarray(box_valid)
    forms = {"loop": _owners_by_box, "reduction": _owners_by_rank}
    return in_form(form, forms, *given, cpu="loop", default="reduction")


def _volume(boxes: Array) -> Array:
    return boxes[:, 3] * boxes[:, 4] * boxes[:, 5]


def _owners_by_box(points: Array, present: Array, boxes: Array, box_valid: Array) -> Array:
    """One box after the other: a loop, fast where memory is the limit."""
    volume = _volume(boxes)

    def visit(best: tuple[Array, Array], index: Array) -> tuple[tuple[Array, Array], None]:
        least, owner = best
        inside = points_in_box(points, boxes[index]) & present & box_valid[index]
        better = inside & (volume[index] < least)
        return (jnp.where(better, volume[index], least), jnp.where(better, index, owner)), None

    start = (jnp.full(points.shape[0], jnp.inf, points.dtype), jnp.full(points.shape[0], -1, jnp.int32))
    return lax.scan(visit, start, jnp.arange(boxes.shape[0], dtype=jnp.int32))[0][1]


def _owners_by_rank(points: Array, present: Array, boxes: Array, box_valid: Array) -> Array:
    """All boxes at once, from the smallest: one reduction over [points, boxes], which is never written out."""
    number, volume = boxes.shape[0], _volume(boxes)
    order = jnp.argsort(volume, stable=True).astype(jnp.int32)
    boxes, eligible = boxes[order], (box_valid & (volume < jnp.inf))[order]
    inside = points_in_box(points[:, None], boxes) & present[:, None] & eligible
    rank = jnp.where(inside, lax.iota(jnp.int32, number), number).min(axis=1, initial=number)
    return jnp.append(order, jnp.int32(-1))[rank]


def _edges(group: Array, num_boxes: int) -> Array:
    """Where each group begins among sorted groups, i32[num_boxes + 1]."""
    return search(group, lax.iota(group.dtype, num_boxes + 1)).astype(jnp.int32)


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
    edges = _edges(group, num_boxes)
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
    rank = lax.iota(jnp.int32, num_locations) - _edges(group, num_boxes)[group]
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
