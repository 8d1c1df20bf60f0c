"""Rotated non-maximum suppression with static shapes (paper, section 3.4)."""

import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.forms import in_form
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.iou import oriented, oriented_overlap
from fcos_lidar_jax.types import check_rows

_Members = Callable[[Array, Array, tuple[Array, ...]], tuple[Array, Array]]
_BLOCK = 512  # Boxes that are compared with a kept box at once; blocks without valid boxes are skipped.
_ROUNDING = 1e-5  # Overlaps that are not told from zero.
_MAX_TURN_RAD = np.pi / 3  # Merged boxes must agree on the heading within this angle.


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
    """Greedy suppression: keep the best box, remove boxes that overlap it by more than the threshold, repeat.

    Args:
        boxes: ``x, y, z, l, w, h, yaw, ...``. A box with NaN in a column that ``overlap`` uses overlaps no
            other box.
        scores: higher is better; the lower index wins among equal scores. NaN counts as invalid.
        valid: False for padding.
        labels: boxes with different labels never suppress each other; None for one class.
        iou_threshold: a box is suppressed if IoU > threshold (static).
        max_outputs: d, the maximum number of kept boxes (static).
        overlap: ``"bev"`` for IoU in the ground plane, ``"3d"`` for IoU in 3D (static).
        form: ``"rows"`` computes one row of IoUs per kept box, ``"matrix"`` the whole matrix and a fixed point,
            with equal results (static). None selects rows on CPUs and the matrix elsewhere, when the program runs.

    Returns:
        indices of the kept boxes by decreasing score, 0 in unused slots, and a mask of the used slots.

    Raises:
        ValueError: at trace time, if ``max_outputs`` is below 1 or the arrays have different lengths.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0], [9, 0, 0, 4, 2, 1, 0]])
    >>> scores, valid = jnp.array([0.5, 0.9, 0.1]), jnp.ones(3, bool)
    >>> kept, used = rotated_nms(boxes, scores, valid, iou_threshold=0.2, max_outputs=3)
    >>> kept.tolist(), used.tolist()
    ([1, 2, 0], [True, True, False])
    >>> compiled = jax.jit(rotated_nms, static_argnames=("iou_threshold", "max_outputs"))
    >>> compiled(boxes, scores, valid, iou_threshold=0.2, max_outputs=3)[0].tolist()
    [1, 2, 0]
    """
    check(max_outputs >= 1, "max_outputs", max_outputs, "at least 1")
    labels = jnp.zeros(len(boxes), jnp.int32) if labels is None else jnp.asarray(labels)
    check_rows(len(boxes), scores=scores, valid=valid, labels=labels)
    if not len(scores):
        return jnp.zeros(max_outputs, jnp.int32), jnp.zeros(max_outputs, bool)
    usable = jnp.asarray(valid) & ~jnp.isnan(scores)
    scores = jnp.where(usable, scores, -jnp.inf)
    options = {"threshold": iou_threshold, "max_outputs": max_outputs, "vertical": _is_vertical(overlap)}
    rows, matrix = (functools.partial(suppress, **options) for suppress in (_by_rows, _by_matrix))
    candidates = oriented(boxes), scores, usable, labels
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
    """Weighted NMS (RangeDet: Fan et al., ICCV 2021): refine the kept boxes with the suppressed boxes.

    Each kept box becomes the mean, weighted by squared scores, of the valid boxes with its label that overlap it
    by more than the threshold and whose headings differ by at most 60 degrees. Yaws are averaged as differences.

    Args:
        boxes, scores, valid, labels, overlap: arguments of :func:`rotated_nms`; columns after the seventh are
            averaged, too.
        kept, used: result of :func:`rotated_nms`.
        iou_threshold: a box is averaged if IoU > threshold (static).
        form: ``"rows"`` computes one row of IoUs per kept box, ``"matrix"`` the whole matrix; equal up to rounding
            (static). None selects rows on CPUs and the matrix elsewhere, when the program runs.

    Returns:
        merged boxes, zero in unused slots.

    Raises:
        ValueError: at trace time, if the arrays have different lengths.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0]])
    >>> valid, best = jnp.ones(2, bool), (jnp.array([0]), jnp.array([True]))
    >>> merge_boxes(boxes, jnp.array([0.8, 0.4]), valid, *best, iou_threshold=0.3)[0, 0].round(3).tolist()
    0.10000000149011612
    """
    labels = jnp.zeros(len(boxes), jnp.int32) if labels is None else jnp.asarray(labels)
    check_rows(len(boxes), scores=scores, valid=valid, labels=labels)
    if not len(scores):
        return jnp.zeros((*kept.shape, boxes.shape[1]), jnp.float32)
    usable = jnp.asarray(valid) & ~jnp.isnan(scores)
    weights = jnp.where(usable, scores, 0.0) ** 2
    members = functools.partial(_sum_members, threshold=iou_threshold, vertical=_is_vertical(overlap))
    arrays = jnp.asarray(boxes, jnp.float32), weights, labels, usable, kept, used
    rows, matrix = (functools.partial(merge, members) for merge in (_merged_by_rows, _merged_by_matrix))
    return in_form(form, {"rows": rows, "matrix": matrix}, *arrays, cpu="rows", default="matrix")


def suppress(
    boxes: Array, scores: Array, labels: Array, valid: Array, config: InferenceConfig
) -> tuple[Array, Array, Array, Array]:
    """Apply rotated NMS, per class unless ``config.nms_across_classes``, to the candidates of one cloud.

    Returns boxes f32[d, 9], scores f32[d], labels i32[d], valid bool[d], best first; zero where invalid.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0, 0, 0], [0.5, 0, 0, 4, 2, 1, 0, 0, 0]])
    >>> scores, labels, valid = jnp.array([0.5, 0.75]), jnp.zeros(2, jnp.int32), jnp.ones(2, bool)
    >>> suppress(boxes, scores, labels, valid, InferenceConfig(max_detections=3))[1].tolist()
    [0.75, 0.0, 0.0]
    """
    options: dict[str, Any] = {"overlap": config.nms_overlap}
    with jax.named_scope("nms"):
        index, used = rotated_nms(
            boxes,
            scores,
            valid,
            **options,
            labels=None if config.nms_across_classes else labels,
            iou_threshold=config.iou_threshold,
            max_outputs=config.max_detections,
        )
    if config.merge_iou is None:
        best_boxes = jnp.where(used[:, None], boxes[index], 0.0)
    else:
        options |= {"labels": labels, "iou_threshold": config.merge_iou}
        best_boxes = merge_boxes(boxes, scores, valid, index, used, **options)
    return best_boxes, jnp.where(used, scores[index], 0.0), jnp.where(used, labels[index], 0), used


def _is_vertical(overlap: str) -> bool:
    """Whether an overlap is measured in 3D; rejects other names than ``"bev"`` and ``"3d"``."""
    if overlap not in ("bev", "3d"):
        raise ValueError(f"overlap: got {overlap!r}, expected 'bev' or '3d'")
    return overlap == "3d"


def _sum_members(
    box: Array, label: Array, candidates: tuple[Array, ...], *, threshold: float, vertical: bool
) -> tuple[Array, Array]:
    """Sums of the weighted offsets, c, and of the weights of the candidates that a box is merged with."""
    boxes, oriented_boxes, weights, labels = candidates
    turn = wrap_angle(boxes[:, 6] - box[6])
    # Elementwise, because updating one column would make a GPU materialize [kept, n, c].
    offsets = jnp.where(lax.iota(jnp.int32, box.shape[0]) == 6, turn[:, None], boxes - box)
    member = _overlaps(oriented(box), oriented_boxes, threshold, vertical)
    member &= (labels == label) & (jnp.abs(turn) <= _MAX_TURN_RAD)
    weight = jnp.where(member, weights, 0.0)
    return jnp.where(weight[:, None] > 0, weight[:, None] * offsets, 0.0).sum(axis=0), weight.sum()


def _moved(boxes: Array, shift: Array, weight: Array, used: Array) -> Array:
    """Move boxes, [d, c], by the mean offset of their members."""
    mean = boxes + shift / jnp.where(weight > 0, weight, 1.0)[:, None]
    return jnp.where(used[:, None], mean.at[:, 6].set(wrap_angle(mean[:, 6])), 0.0)


def _merged_by_rows(
    members: _Members, boxes: Array, weights: Array, labels: Array, usable: Array, kept: Array, used: Array
) -> Array:
    """Compare the kept boxes with the boxes of a block one at a time."""
    kept_boxes, kept_labels = boxes[kept], labels[kept]
    order = jnp.argsort(~usable, stable=True)
    blocks = _in_blocks(boxes[order], oriented(boxes[order]), weights[order], labels[order])

    def within(block: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        candidates = tuple(array[block] for array in blocks)

        def add(slot: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
            shift, weight = members(kept_boxes[slot], kept_labels[slot], candidates)
            return sums[0].at[slot].add(shift), sums[1].at[slot].add(weight)

        return lax.fori_loop(0, used.sum(), add, sums)

    nothing = jnp.zeros_like(kept_boxes), jnp.zeros_like(kept_boxes[:, 0])
    shift, weight = lax.fori_loop(0, _num_blocks(usable), within, nothing)
    return _moved(kept_boxes, shift, weight, used)


def _merged_by_matrix(
    members: _Members, boxes: Array, weights: Array, labels: Array, usable: Array, kept: Array, used: Array
) -> Array:
    """Compare all kept boxes with all boxes in one reduction over [kept, n]."""
    candidates = boxes, oriented(boxes), weights, labels
    sums = jax.vmap(members, (0, 0, None))(boxes[kept], labels[kept], candidates)
    return _moved(boxes[kept], *sums, used)


def _overlaps(a: Array, b: Array, threshold: float, vertical: bool) -> Array:
    """IoU > threshold, computed without a division; False where the union is zero.

    The intersection of distant boxes is zero only up to rounding, about 1e-7 of the union.
    """
    intersection, union = oriented_overlap(a, b, vertical=vertical)
    return intersection > max(threshold, _ROUNDING) * union


def _in_blocks(*arrays: Array) -> list[Array]:
    """Reshape arrays to [blocks, block, ...], padded with zeros."""
    count = len(arrays[0])
    block = min(_BLOCK, count)
    padded = (jnp.pad(array, [(0, -count % block)] + [(0, 0)] * (array.ndim - 1)) for array in arrays)
    return [array.reshape(-1, block, *array.shape[1:]) for array in padded]


def _num_blocks(valid: Array) -> Array:
    """Number of blocks that contain all valid boxes, which come first."""
    block = min(_BLOCK, len(valid))
    return (valid.sum() + block - 1) // block


def _ranking(scores: Array, valid: Array) -> Array:
    """Order of the boxes: valid ones first, by decreasing score, then by index."""
    return jnp.lexsort((-scores, ~valid)).astype(jnp.int32)


def _by_rows(
    boxes: Array, scores: Array, valid: Array, labels: Array, *, threshold: float, max_outputs: int, vertical: bool
) -> tuple[Array, Array]:
    """Compare the boxes of a block, best block first, with the kept boxes of earlier blocks, then with its own."""
    order = _ranking(scores, valid)
    boxes, labels = boxes[order], labels[order]
    blocks = _in_blocks(boxes, labels, valid[order])
    size = blocks[0].shape[1]

    def within(block: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        others, other_labels, alive = (array[block] for array in blocks)

        def unfinished(state: tuple[Array, Array, Array, Array]) -> Array:
            _, count, _, alive = state
            return (count < max_outputs) & alive.any()

        def compare(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            slot, count, kept, alive = state
            best = jnp.argmax(alive).astype(jnp.int32)  # The boxes are ordered by score.
            is_new = slot == count
            kept = kept.at[slot].set(jnp.where(is_new, block * size + best, kept[slot]))
            box, label = boxes[kept[slot]], labels[kept[slot]]
            rivals = _overlaps(box, others, threshold, vertical) & (other_labels == label)
            # Elementwise, because a scatter would be fused with the comparison, which is slower.
            alive &= ~rivals & ~(is_new & (lax.iota(jnp.int32, size) == best))
            return slot + 1, count + is_new, kept, alive

        _, count, kept, _ = lax.while_loop(unfinished, compare, (jnp.int32(0), *state, alive))
        return count, kept

    start = jnp.int32(0), jnp.zeros(max_outputs, jnp.int32)
    count, kept = lax.fori_loop(0, _num_blocks(valid), within, start)
    used = jnp.arange(max_outputs) < count
    return jnp.where(used, order[kept], 0), used


def _by_matrix(
    boxes: Array, scores: Array, valid: Array, labels: Array, *, threshold: float, max_outputs: int, vertical: bool
) -> tuple[Array, Array]:
    num_boxes = scores.shape[0]
    order = _ranking(scores, valid)
    boxes, labels, valid = boxes[order], labels[order], valid[order]
    beats = _overlaps(boxes[:, None], boxes[None, :], threshold, vertical) & (labels[:, None] == labels)
    beats &= jnp.arange(num_boxes)[:, None] < jnp.arange(num_boxes)

    def suppress(state: tuple[Array, Array]) -> tuple[Array, Array]:
        kept, _ = state
        after = valid & ~(beats & kept[:, None]).any(axis=0)
        return after, (after != kept).any()

    kept, _ = lax.while_loop(lambda state: state[1], suppress, (valid, jnp.bool_(True)))
    slot = jnp.where(kept, jnp.cumsum(kept) - 1, max_outputs)
    indices = jnp.zeros(max_outputs, jnp.int32).at[slot].set(order, mode="drop")
    return indices, jnp.arange(max_outputs) < kept.sum()
