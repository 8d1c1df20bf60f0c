"""The objective of a batch: what the network predicts, what it should, and the losses between, as sums."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.assignment import assign, owners
from fcos_lidar_jax.coding import decode_oriented, encode
from fcos_lidar_jax.config import Config, LossConfig
from fcos_lidar_jax.iou import oriented, oriented_iou_3d
from fcos_lidar_jax.locations import ImageLayout, image_layout, image_sensor, locate
from fcos_lidar_jax.losses import (
    classification_loss,
    combine,
    cross_entropy,
    iou_loss,
    iou_prediction_loss,
    l1_loss,
    loss_terms,
)
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.types import Batch, Locations, Outputs, RangeImage, Targets

Metrics = dict[str, Array]


def location_owners(image: RangeImage, locations: Locations, boxes: Array, box_valid: Array) -> Array:
    """The box of every location of one sample, -1 for none.

    Tested once for each cell of the sensor's image: repeated rows and coarser levels see the same points.

    Args:
        image: of one sample.
        locations: of the same.
        boxes: f32[m, 9].
        box_valid: bool[m].
    """
    first = image.features[..., 0].reshape(-1, 9)
    cell_owner = owners(first[:, :3], first[:, 7] > 0, boxes, box_valid)
    owner = cell_owner[jnp.maximum(locations.cell, 0)]
    return jnp.where(locations.occupied, owner, -1)


def sample_losses(
    outputs: Outputs,
    image: RangeImage,
    boxes: Array,
    labels: Array,
    box_valid: Array,
    *,
    config: LossConfig,
    layout: ImageLayout,
) -> tuple[dict[str, tuple[Array, Array]], Targets, Metrics]:
    """Assignment and losses of one sample (paper, section 3.4).

    Args:
        outputs: of one sample.
        image: likewise.
        boxes: f32[m, 9]; NaN velocities are unknown.
        labels: i32[m].
        box_valid: bool[m].
        config: weights and choices (static).
        layout: sizes (static).

    Returns:
        the four losses as (sum, count), the targets, and counts to be summed over the batch.
    """
    background = outputs.logits.shape[-1] - 1
    locations = locate(image, layout)
    owner = location_owners(image, locations, boxes, box_valid)
    owned = jnp.maximum(owner, 0)
    box, label = boxes[owned], labels[owned]

    regression = jnp.take_along_axis(outputs.regression, label[:, None, None], axis=2)[..., 0]
    iou_logit = jnp.take_along_axis(outputs.iou_logits, label[:, None], axis=1)[:, 0]
    # What has no owner gets a harmless box, so that nothing overflows on the way to being masked.
    box = jnp.where((owner >= 0)[:, None], box, jnp.array([0, 0, 0, 1, 1, 1, 0, 0, 0], jnp.float32))
    predicted = decode_oriented(regression, locations.points, locations.azimuth_rad)
    truth = oriented(box)
    iou = oriented_iou_3d(lax.stop_gradient(predicted), truth)
    targets = assign(
        owner,
        cross_entropy(lax.stop_gradient(outputs.logits), label),
        iou,
        num_boxes=boxes.shape[0],
        top_q=config.top_q,
    )
    positive = targets.positive
    regressed = positive if config.regress_on == "positives" else owner >= 0
    with jax.named_scope("losses"):
        parts = {
            "classification": classification_loss(
                outputs.logits, jnp.where(positive, label, background), locations.occupied
            ),
            "l1": l1_loss(
                regression,
                encode(box, locations.points, locations.azimuth_rad),
                regressed,
                velocity_weight=config.velocity_weight,
            ),
            "iou": iou_loss(predicted, truth, regressed, kind=config.iou_loss),
            "iou_prediction": iou_prediction_loss(iou_logit, iou, regressed),
        }
    cells = jnp.zeros(layout.rows * layout.columns + 1, bool)
    cells = cells.at[jnp.where(positive, locations.cell, -1)].set(True)
    counts = {
        "positives": positive.sum(dtype=jnp.int32),
        "unique_positives": cells[:-1].sum(dtype=jnp.int32),
        "candidates": (owner >= 0).sum(dtype=jnp.int32),
        "owned_boxes": (targets.num_positive > 0).sum(dtype=jnp.int32),
        "iou_sum": jnp.where(positive, iou, 0.0).sum(),
        "positives_per_level": _per_level(positive, layout),
    }
    return parts, targets, counts


def _per_level(positive: Array, layout: ImageLayout) -> Array:
    ends = np.cumsum(layout.level_sizes)
    return jnp.stack([part.sum(dtype=jnp.int32) for part in jnp.split(positive, ends[:-1])])


Loss = Callable[[Any, Any, Batch], tuple[Array, tuple[Any, Metrics]]]
"""``(params, batch_stats, batch) -> (loss, (batch_stats, metrics))``."""


def make_sums(
    detector: Detector,
) -> Callable[[Any, Any, Batch], tuple[Metrics, tuple[Any, Metrics, Metrics]]]:
    """The weighted losses of a batch of raw points before the division, summed by the count that divides them.

    Sums and counts add up over micro-batches and devices; :func:`batch_metrics` divides them once.

    Args:
        detector: from :func:`fcos_lidar_jax.models.build_detector`.

    Returns:
        pure ``(params, batch_stats, batch) -> ({count: sum}, (batch_stats, parts, counts))``.
    """
    config, sensor = detector.config, detector.sensor
    binned, layout = image_sensor(sensor, config.model), image_layout(sensor, config.model)
    projection = config.projection

    def project(points: Array, valid: Array) -> RangeImage:
        return project_points(
            points,
            valid,
            binned,
            num_rounds=projection.num_rounds,
            prioritize_current=projection.prioritize_current,
        )

    def losses_of(outputs: Outputs, image: RangeImage, boxes: Array, labels: Array, box_valid: Array) -> Any:
        return sample_losses(outputs, image, boxes, labels, box_valid, config=config.loss, layout=layout)

    def sums(params: Any, batch_stats: Any, batch: Batch) -> tuple[Metrics, tuple[Any, Metrics, Metrics]]:
        with jax.named_scope("mrv"):
            image = jax.vmap(project)(batch.points, batch.valid)
        variables = {"params": params, "batch_stats": batch_stats}
        outputs, batch_stats = detector.apply(variables, image.features, train=True)
        parts, _, counts = jax.vmap(losses_of)(outputs, image, batch.boxes, batch.labels, batch.box_valid)
        counts["dropped_points"] = image.num_dropped
        parts, counts = jax.tree.map(
            lambda leaf: leaf.sum(axis=0), ({name: part[0] for name, part in parts.items()}, counts)
        )
        totals: dict[str, Array] = {}
        for name, (weight, divisor) in loss_terms(config.loss).items():
            totals[divisor] = totals.get(divisor, 0) + weight * parts[name]
        return totals, (batch_stats, parts, counts)

    return sums


def batch_metrics(parts: Metrics, counts: Metrics, config: Config) -> Metrics:
    """The metrics of a whole batch from its sums: each loss divided once by its count.

    Args:
        parts: sums of the losses.
        counts: from :func:`make_sums`.
        config: the weights.
    """
    losses = combine(parts, counts, config.loss)
    positives = jnp.maximum(counts["positives"], 1)
    metrics = {f"loss/{name}": value for name, value in losses.items()}
    metrics |= {name: value for name, value in counts.items() if name != "iou_sum"}
    metrics["positive_iou"] = counts["iou_sum"] / positives
    metrics["mean_k"] = counts["positives"] / jnp.maximum(counts["owned_boxes"], 1)
    return metrics


def make_loss(detector: Detector) -> Loss:
    """The loss of a batch of raw points as a pure function.

    Args:
        detector: from :func:`fcos_lidar_jax.models.build_detector`.

    Returns:
        ``(params, batch_stats, batch) -> (loss, (batch_stats, metrics))``.
    """
    sums = make_sums(detector)

    def loss(params: Any, batch_stats: Any, batch: Batch) -> tuple[Array, tuple[Any, Metrics]]:
        _, (batch_stats, parts, counts) = sums(params, batch_stats, batch)
        metrics = batch_metrics(parts, counts, detector.config)
        return metrics["loss/total"], (batch_stats, metrics)

    return loss
