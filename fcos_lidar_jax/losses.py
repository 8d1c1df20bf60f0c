"""Losses of one sample (paper, section 3.4), each as (sum, count).

Arrays of different lengths raise a ValueError when the loss is traced.

Each sum is divided once, over the global batch. A mean per sample or per device would give more weight to the
positives of samples with few positives.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Float32, Int32

from fcos_lidar_jax.config import LossConfig
from fcos_lidar_jax.iou import oriented_overlap
from fcos_lidar_jax.types import ORIENTED, check_columns, check_rows

SumCount = tuple[Float[Array, ""], Int32[Array, ""]]


def _masked(values: Array, mask: Array) -> SumCount:
    return jnp.where(mask, values, 0.0).sum(), mask.sum(dtype=jnp.int32)


def cross_entropy(logits: Float32[Array, "l c"], labels: Int32[Array, "l"]) -> Float32[Array, "l"]:
    """Softmax cross-entropy with class indices, one value per location.

    >>> round(float(cross_entropy(jnp.zeros((1, 2)), jnp.array([0]))[0]), 4)
    0.6931
    """
    check_rows(len(logits), labels=labels)
    return -jnp.take_along_axis(jax.nn.log_softmax(logits), labels[:, None], axis=1)[:, 0]


def classification_loss(
    logits: Float32[Array, "l c"], labels: Int32[Array, "l"], mask: Bool[Array, "l"]
) -> SumCount:
    """Cross-entropy over the non-empty locations, given by ``mask``; label k is the background.

    The gradient is zero at all other locations, even if their logits are not finite.

    >>> total, count = classification_loss(jnp.zeros((2, 2)), jnp.array([0, 1]), jnp.array([True, False]))
    >>> round(float(total), 4), int(count)
    (0.6931, 1)
    """
    check_rows(len(logits), mask=mask)
    # Replace masked logits, which may be NaN: 0 * NaN is NaN in the gradient.
    return _masked(cross_entropy(jnp.where(mask[:, None], logits, 0.0), labels), mask)


def l1_loss(
    prediction: Float32[Array, "l 10"],
    target: Float32[Array, "l 10"],
    mask: Bool[Array, "l"],
    *,
    velocity_weight: float,
) -> SumCount:
    """Weighted sum of absolute differences of the ten regression values.

    Args:
        prediction: regression values of the owner's class.
        target: from :func:`fcos_lidar_jax.coding.encode`; a NaN velocity is unknown and adds no loss.
        mask: locations to sum over.
        velocity_weight: weight of the last two values; the other weights are 1.

    >>> total, _ = l1_loss(jnp.ones((1, 10)), jnp.zeros((1, 10)), jnp.ones(1, bool), velocity_weight=0.2)
    >>> round(float(total), 4)
    8.4
    """
    check_rows(len(prediction), axes=2, target=target)
    check_rows(len(prediction), mask=mask)
    known = ~jnp.isnan(target)
    difference = jnp.where(known & mask[:, None], prediction - jnp.where(known, target, 0.0), 0.0)
    weights = jnp.array([1.0] * 8 + [velocity_weight] * 2, prediction.dtype)
    return _masked((jnp.abs(difference) * weights).sum(axis=1), mask)


def iou_loss(
    prediction: Float32[Array, "l c"], target: Float32[Array, "l d"], mask: Bool[Array, "l"], *, kind: str = "iou"
) -> SumCount:
    """Loss from the rotated 3D IoU of predicted and true boxes.

    Args:
        prediction, target: ``x, y, z, l, w, h, cos yaw, sin yaw``.
        mask: locations to sum over.
        kind: ``"iou"`` is 1 - IoU, ``"log_iou"`` is -ln IoU (UnitBox), ``"giou"`` and ``"diou"`` use the smallest
            box that encloses both and is aligned with the target (static).

    Raises:
        ValueError: at trace time, for an unknown kind or another number of columns.

    >>> box = jnp.array([[0, 0, 0, 4, 2, 1, 1, 0]], jnp.float32)
    >>> float(iou_loss(box, box, jnp.ones(1, bool))[0])
    0.0
    """
    for name, boxes in (("prediction", prediction), ("target", target)):
        check_columns(name, boxes, ORIENTED)
    check_rows(len(prediction), axes=2, target=target)
    check_rows(len(prediction), mask=mask)
    # Replace masked boxes before they can overflow: 0 * inf is NaN in the gradient.
    unit = jnp.array([0, 0, 0, 1, 1, 1, 1, 0], prediction.dtype)
    prediction = jnp.where(mask[:, None], prediction, unit)
    target = jnp.where(mask[:, None], target, unit)
    intersection, union = oriented_overlap(prediction, target, vertical=True)
    union = jnp.maximum(union, 1e-6)
    iou = intersection / union
    if kind == "iou":
        values = 1 - iou
    elif kind == "log_iou":
        values = -jnp.log(jnp.maximum(iou, 1e-6))
    elif kind in ("giou", "diou"):
        extent = _enclosing(prediction, target)
        if kind == "giou":
            volume = jnp.maximum(extent[..., 0] * extent[..., 1] * extent[..., 2], 1e-6)
            values = 1 - iou + (volume - union) / volume
        else:
            distance = jnp.square(prediction[:, :3] - target[:, :3]).sum(axis=1)
            values = 1 - iou + distance / jnp.maximum(jnp.square(extent).sum(axis=1), 1e-6)
    else:
        raise ValueError(f"kind: got {kind!r}, expected 'iou', 'log_iou', 'giou' or 'diou'")
    return _masked(values, mask)


def _enclosing(prediction: Array, target: Array) -> Array:
    """Length, width and height of the enclosing box along the axes of the target."""
    x, y, z, l, w, h, cos, sin = (target[:, i] for i in range(8))
    px, py, pz, pl, pw, ph, pcos, psin = (prediction[:, i] for i in range(8))
    dx, dy = px - x, py - y
    along, across = cos * dx + sin * dy, cos * dy - sin * dx
    rcos, rsin = jnp.abs(cos * pcos + sin * psin), jnp.abs(cos * psin - sin * pcos)
    axes = [(along, rcos * pl + rsin * pw, l), (across, rsin * pl + rcos * pw, w), (pz - z, ph, h)]
    extent = [jnp.maximum(d + s / 2, t / 2) - jnp.minimum(d - s / 2, -t / 2) for d, s, t in axes]
    return jnp.stack(extent, axis=-1)


def centreness(
    prediction: Float32[Array, "l 8"], target: Float32[Array, "l 8"], width_m: float
) -> Float32[Array, "l"]:
    """Closeness of predicted and true centres, ``exp(-d^2 / width_m^2)`` for their 3D distance d.

    An alternative to the IoU as the factor of the score, which is not stricter for small boxes. Wilson et al.
    (What matters in range view 3D object detection, CoRL 2024) use it as the classification target and to select
    positives; here the assignment is unchanged.

    >>> round(float(centreness(jnp.zeros((1, 8)), jnp.zeros((1, 8)).at[0, 0].set(0.5), 0.5)[0]), 4)
    0.3679
    """
    return jnp.exp(-jnp.square((prediction - target)[:, :3]).sum(axis=1) / width_m**2)


def iou_prediction_loss(logits: Float32[Array, "l"], iou: Float32[Array, "l"], mask: Bool[Array, "l"]) -> SumCount:
    """Binary cross-entropy of the predicted IoU with the measured IoU, which receives no gradient.

    >>> total, _ = iou_prediction_loss(jnp.zeros(1), jnp.ones(1), jnp.ones(1, bool))
    >>> round(float(total), 4)
    0.6931
    """
    check_rows(len(logits), logits=logits, iou=iou, mask=mask)
    iou = lax.stop_gradient(iou)
    logits = jnp.where(mask, logits, 0.0)  # masked logits may be NaN, as above
    return _masked(jax.nn.softplus(logits) - iou * logits, mask)


def weighted(losses: Mapping[str, Array], config: LossConfig) -> Array:
    """The weighted sum of losses, ``NAME_weight`` of the configuration (static) times NAME, or times 1.

    >>> float(weighted({"l1": jnp.float32(4), "mine": jnp.float32(3)}, LossConfig()))
    4.0
    """
    weights = {n.removesuffix("_weight"): w for n, w in vars(config).items() if n.endswith("_weight")}
    names = [*(name for name in weights if name in losses), *(name for name in losses if name not in weights)]
    return sum(weights.get(name, 1.0) * losses[name] for name in names)  # type: ignore[return-value]
