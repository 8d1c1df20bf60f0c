"""The objective of CenterPoint: what :mod:`fcos_lidar_jax.training.objective` is for the range view."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from fcos_lidar_jax.centres import centre_targets, decode_centres, encode_centres, focal_loss
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.iou import oriented, oriented_iou_3d
from fcos_lidar_jax.losses import l1_loss
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.pillars import Grid, make_pillars, pillar_grid
from fcos_lidar_jax.types import Batch, CentreOutputs

Metrics = dict[str, Array]


def sample_losses(
    outputs: CentreOutputs, boxes: Array, labels: Array, box_valid: Array, *, config: Config, grid: Grid
) -> tuple[Metrics, Metrics]:
    """Targets and losses of one sample.

    Args:
        outputs: of one sample, as are the other arrays.
        boxes: f32[m, 9]; NaN velocities are unknown.
        labels, box_valid: i32[m] and bool[m].
        config, grid: choices, and the cells of the heat map (static).

    Returns:
        sums of the two losses and counts of the boxes, each f32[g] or i32[g] by group of classes, and counts to be
        summed over the batch.
    """
    assert config.pillars is not None
    pillars, groups = config.pillars, jnp.array(config.class_groups)
    targets = centre_targets(
        boxes,
        labels,
        box_valid,
        grid=grid,
        num_classes=len(config.classes),
        min_overlap=pillars.min_overlap,
        min_radius=pillars.min_radius,
    )
    with jax.named_scope("losses"):
        group = groups[jnp.where(targets.valid, labels, 0)]
        own = targets.valid & (group == jnp.arange(outputs.regression.shape[-2])[:, None])
        away, at_boxes = focal_loss(outputs.heat, targets.heat, targets.cell, labels, targets.valid)
        regression = outputs.regression.reshape(-1, *outputs.regression.shape[-2:])[targets.cell, group]
        numbers = encode_centres(targets.boxes, targets.cell, grid)
        weight = config.loss.velocity_weight
        l1 = [l1_loss(regression, numbers, mask, velocity_weight=weight)[0] for mask in own]
        parts = {
            "classification": jnp.zeros(own.shape[0]).at[groups].add(away) + (own * at_boxes).sum(axis=1),
            "l1": jnp.stack(l1),
        }
    predicted = decode_centres(regression, targets.cell, grid, oriented=True)
    iou = oriented_iou_3d(predicted, oriented(targets.boxes))
    counts = {"positives": own.sum(axis=1, dtype=jnp.int32), "iou_sum": jnp.where(targets.valid, iou, 0.0).sum()}
    return parts, counts


def make_sums(detector: Detector) -> Callable[[Any, Any, Batch], tuple[Metrics, tuple[Any, Metrics, Metrics]]]:
    """The weighted losses of a batch of raw points before the division, as of
    :func:`fcos_lidar_jax.training.objective.make_sums`.

    The losses of every group of classes are divided by its own boxes: its sums are weighed so that the one
    division by all boxes does it. Over micro-batches this is exact with one group; with more, each has its shares.
    """
    config, sensor = detector.config, detector.sensor
    assert config.pillars is not None
    grid = pillar_grid(config.pillars, sensor)
    cells = pillar_grid(config.pillars, sensor, stride=config.pillars.output_stride)

    def sums(params: Any, batch_stats: Any, batch: Batch) -> tuple[Metrics, tuple[Any, Metrics, Metrics]]:
        pillars = jax.vmap(lambda p, v: make_pillars(p, v, grid=grid, sensor=sensor))(batch.points, batch.valid)
        variables = {"params": params, "batch_stats": batch_stats}
        outputs, batch_stats = detector.apply(variables, pillars, train=True)
        parts, counts = jax.vmap(lambda *sample: sample_losses(*sample, config=config, grid=cells))(
            outputs, batch.boxes, batch.labels, batch.box_valid
        )
        counts["dropped_points"] = pillars.num_dropped
        parts, counts = jax.tree.map(lambda leaf: leaf.sum(axis=0), (parts, counts))
        by_group = counts["positives"]
        counts["positives"] = by_group.sum()
        share = jnp.maximum(counts["positives"], 1) / jnp.maximum(by_group, 1)
        parts = {name: (part * share).sum() for name, part in parts.items()}
        total = sum(weight * parts[name] for name, weight in _weights(config).items())
        return {"positives": total}, (batch_stats, parts, counts)  # type: ignore[dict-item]

    return sums


def _weights(config: Config) -> dict[str, float]:
    return {"classification": config.loss.classification_weight, "l1": config.loss.l1_weight}


def batch_metrics(parts: Metrics, counts: Metrics, config: Config) -> Metrics:
    """The metrics of a whole batch from the sums of :func:`make_sums`."""
    boxes = jnp.maximum(counts["positives"], 1)
    metrics = {f"loss/{name}": part / boxes for name, part in parts.items()}
    metrics["loss/total"] = sum(weight * metrics[f"loss/{name}"] for name, weight in _weights(config).items())  # type: ignore[assignment]
    metrics |= {name: counts[name] for name in ("positives", "dropped_points")}
    return metrics | {"positive_iou": counts["iou_sum"] / boxes}
