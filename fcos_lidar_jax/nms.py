"""Rotated non-maximum suppression with static shapes (paper, section 3.4)."""

import functools
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.forms import in_form
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.iou import oriented, oriented_overlap

T = TypeVar("T")
_FEW = (1024, 2048)  # A trained detector has mostly no more valid boxes, of thousands of slots.
_MAX_TURN_RAD = np.pi / 3  # Boxes that point elsewhere are no estimates of the same heading.


def rotated_nms(
    boxes: Float32[Array | np.ndarray, "n c"],
    scores: Float32[Array | np.ndarray, "n"],
    valid: Bool[Array | np.ndarray, "n"],
    *,
    labels: Int32[Array | np.ndarray, "n"] | None = None,
    iou_threshold: float,
    max_outputs: int,
    overlap: Literal["bev", "3d"] = "bev",
    form: Literal["rows", "matrix"] | None = None,
) -> tuple[Int32[Array, "d"], Bool[Array, "d"]]:
    """Greedy suppression: the best box stays, whatever overlaps it by more than the threshold goes.

    Args:
        boxes: ``x, y, z, l, w, h, yaw, ...``.
        scores: higher is better; equal scores go to the lower index. NaN counts as invalid.
        valid: rows that take part.
        labels: boxes of different labels never suppress each other; None for one class.
        iou_threshold: suppressed if IoU > threshold (static).
        max_outputs: d, boxes kept at most (static).
        overlap: IoU in the ground plane or of the boxes (static).
        form: one row of IoUs per kept box, or the whole matrix and a fixed point; the same result (static). None:
            rows on a CPU, the matrix elsewhere, decided where the program runs.

    Returns:
        indices of the kept boxes by falling score, 0 in unused slots, and which slots are used.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0], [9, 0, 0, 4, 2, 1, 0]])
    >>> scores, valid = jnp.array([0.5, 0.9, 0.1]), jnp.ones(3, bool)
    >>> kept, used = rotated_nms(boxes, scores, valid, iou_threshold=0.2, max_outputs=3)
    >>> kept.tolist(), used.tolist()
    ([1, 2, 0], [True, True, False])
    """
    usable = jnp.asarray(valid) & ~jnp.isnan(scores)
    ranked = jnp.where(usable, scores, -jnp.inf)
    kinds = jnp.zeros(ranked.shape, jnp.int32) if labels is None else jnp.asarray(labels)
    if overlap not in ("bev", "3d"):
        raise ValueError(f"overlap: got {overlap!r}, expected 'bev' or '3d'")
    options = {"threshold": iou_threshold, "max_outputs": max_outputs, "vertical": overlap == "3d"}
    rows, matrix = (functools.partial(suppress, **options) for suppress in (_by_rows, _by_matrix))
    candidates = oriented(boxes), ranked, usable, kinds
    return in_form(form, {"rows": rows, "matrix": matrix}, *candidates, cpu="rows", default="matrix")


def merge_boxes(
    boxes: Float32[Array | np.ndarray, "n c"],
    scores: Float32[Array | np.ndarray, "n"],
    valid: Bool[Array | np.ndarray, "n"],
    kept: Int32[Array, "d"],
    used: Bool[Array, "d"],
    *,
    labels: Int32[Array | np.ndarray, "n"] | None = None,
    iou_threshold: float,
    overlap: Literal["bev", "3d"] = "bev",
    form: Literal["rows", "matrix"] | None = None,
) -> Float32[Array, "d c"]:
    """Weighted NMS (RangeDet: Fan et al., ICCV 2021): what suppression keeps, improved by what it suppressed.

    Each kept box becomes the mean of itself and of the valid boxes of its label that overlap it by more than the
    threshold and point within 60 degrees of it, weighted by their squared scores; angles as differences.

    Args:
        boxes, scores, valid, labels, overlap: as given to :func:`rotated_nms`; columns after the seventh are
            averaged, too.
        kept, used: what it returned.
        iou_threshold: a box takes part if IoU > threshold (static).
        form: one row of IoUs per kept box, or the whole matrix; equal up to rounding (static). None: rows on a
            CPU, the matrix elsewhere, decided where the program runs.

    Returns:
        the merged boxes, zero in unused slots.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0]])
    >>> valid, best = jnp.ones(2, bool), (jnp.array([0]), jnp.array([True]))
    >>> merge_boxes(boxes, jnp.array([0.8, 0.4]), valid, *best, iou_threshold=0.3)[0, 0].round(3).tolist()
    0.10000000149011612
    """
    usable = jnp.asarray(valid) & ~jnp.isnan(scores)
    weights = jnp.where(usable, scores, 0.0) ** 2
    kinds = jnp.zeros(weights.shape, jnp.int32) if labels is None else jnp.asarray(labels)
    mean = functools.partial(_weighted_mean, threshold=iou_threshold, vertical=overlap == "3d")
    given = jnp.asarray(boxes, jnp.float32), weights, kinds, usable, kept, used
    rows, matrix = (functools.partial(merged, mean) for merged in (_merged_by_rows, _merged_by_matrix))
    return in_form(form, {"rows": rows, "matrix": matrix}, *given, cpu="rows", default="matrix")


def _weighted_mean(
    box: Array, kind: Array, candidates: tuple[Array, ...], *, threshold: float, vertical: bool
) -> Array:
    """A box, c, improved by the candidates, boxes [n, c], that overlap it and are of its kind."""
    boxes, turned, weights, kinds = candidates
    turn = wrap_angle(boxes[:, 6] - box[6])
    # Elementwise throughout: with an update of the column a GPU would write out [kept, n, c].
    offsets = jnp.where(lax.iota(jnp.int32, box.shape[0]) == 6, turn[:, None], boxes - box)
    member = _overlaps(oriented(box), turned, threshold, vertical)
    member &= (kinds == kind) & (jnp.abs(turn) <= _MAX_TURN_RAD)
    weight = jnp.where(member, weights, 0.0)
    shift = jnp.where(weight[:, None] > 0, weight[:, None] * offsets, 0.0).sum(axis=0)
    total = weight.sum()
    mean = box + shift / jnp.where(total > 0, total, 1.0)
    return mean.at[6].set(wrap_angle(mean[6]))


def _merged_by_rows(
    mean: Callable[..., Array], boxes: Array, weights: Array, kinds: Array, usable: Array, kept: Array, used: Array
) -> Array:
    """One kept box after the other: as many turns as there are."""
    best, best_kinds = boxes[kept], kinds[kept]

    def of_best(order: Array) -> Array:
        few = boxes[order], oriented(boxes[order]), weights[order], kinds[order]

        def merged(slot: Array, result: Array) -> Array:
            return result.at[slot].set(mean(best[slot], best_kinds[slot], few))

        return lax.fori_loop(0, used.sum(), merged, jnp.zeros_like(best))

    return _with_few(of_best, jnp.argsort(~usable, stable=True), usable)


def _merged_by_matrix(
    mean: Callable[..., Array], boxes: Array, weights: Array, kinds: Array, usable: Array, kept: Array, used: Array
) -> Array:
    """All kept boxes at once: one reduction over [kept, n]."""
    candidates = boxes, oriented(boxes), weights, kinds
    merged = jax.vmap(mean, (0, 0, None))(boxes[kept], kinds[kept], candidates)
    return jnp.where(used[:, None], merged, 0.0)


def _overlaps(a: Array, b: Array, threshold: float, vertical: bool) -> Array:
    """IoU > threshold, without the division: false where the union vanishes."""
    intersection, union = oriented_overlap(a, b, vertical=vertical)
    return intersection > threshold * union


def _with_few(compute: Callable[[Array], T], order: Array, valid: Array) -> T:
    """What is computed of boxes in an order, valid ones first: of the first few alone where no more are valid."""
    numbers = [*(few for few in _FEW if few < len(order)), len(order)]
    branches = [functools.partial(lambda number: compute(order[:number]), number) for number in numbers]
    return lax.switch(jnp.searchsorted(jnp.array(numbers[:-1], jnp.int32), valid.sum()), branches)


def _ranking(scores: Array, valid: Array) -> Array:
    """Valid boxes first, by falling score, equal ones by index."""
    return jnp.lexsort((-scores, ~valid)).astype(jnp.int32)


def _by_rows(boxes: Array, scores: Array, valid: Array, labels: Array, **options: Any) -> tuple[Array, Array]:
    def of_best(best: Array) -> tuple[Array, Array]:
        kept, used = _greedy(boxes[best], scores[best], valid[best], labels[best], **options)
        return jnp.where(used, best[kept], 0), used

    return _with_few(of_best, _ranking(scores, valid), valid)


def _greedy(
    boxes: Array, scores: Array, valid: Array, labels: Array, *, threshold: float, max_outputs: int, vertical: bool
) -> tuple[Array, Array]:
    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        count, alive, _ = state
        return (count < max_outputs) & alive.any()

    def pick(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, alive, kept = state
        best = jnp.argmax(jnp.where(alive, scores, -jnp.inf)).astype(jnp.int32)
        # A lone box with score -inf is still the best one left.
        best = jnp.where(alive[best], best, jnp.argmax(alive).astype(jnp.int32))
        rivals = _overlaps(boxes[best], boxes, threshold, vertical) & (labels == labels[best])
        return count + 1, (alive & ~rivals).at[best].set(False), kept.at[count].set(best)

    start = (jnp.int32(0), valid, jnp.zeros(max_outputs, jnp.int32))
    count, _, kept = lax.while_loop(unfinished, pick, start)
    return kept, jnp.arange(max_outputs) < count


def _by_matrix(
    boxes: Array, scores: Array, valid: Array, labels: Array, *, threshold: float, max_outputs: int, vertical: bool
) -> tuple[Array, Array]:
    number = scores.shape[0]
    order = _ranking(scores, valid)
    boxes, labels, valid = boxes[order], labels[order], valid[order]
    beats = _overlaps(boxes[:, None], boxes[None, :], threshold, vertical) & (labels[:, None] == labels)
    beats &= jnp.arange(number)[:, None] < jnp.arange(number)

    def suppress(state: tuple[Array, Array]) -> tuple[Array, Array]:
        kept, _ = state
        after = valid & ~(beats & kept[:, None]).any(axis=0)
        return after, (after != kept).any()

    kept, _ = lax.while_loop(lambda state: state[1], suppress, (valid, jnp.bool_(True)))
    slot = jnp.where(kept, jnp.cumsum(kept) - 1, max_outputs)
    indices = jnp.zeros(max_outputs, jnp.int32).at[slot].set(order, mode="drop")
    return indices, jnp.arange(max_outputs) < kept.sum()
