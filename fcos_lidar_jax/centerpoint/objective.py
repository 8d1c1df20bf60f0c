"""Losses of CenterPoint, as sums."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from fcos_lidar_jax.centerpoint.centres import centre_targets, decode_centres, encode_centres, focal_loss
from fcos_lidar_jax.centerpoint.pillar_config import PillarConfig
from fcos_lidar_jax.centerpoint.pillars import Grid
from fcos_lidar_jax.centerpoint.types import CentreOutputs
from fcos_lidar_jax.collectives import sum_over_devices
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.iou import oriented, oriented_iou_3d
from fcos_lidar_jax.losses import l1_loss
from fcos_lidar_jax.types import Batch, Sums

Parts = dict[str, Array]


def sample_losses(
    outputs: CentreOutputs,
    boxes: Array,
    labels: Array,
    box_valid: Array,
    *,
    config: Config,
    pillars: PillarConfig,
    grid: Grid,
) -> tuple[Parts, Parts]:
    """Compute targets and losses of one sample.

    Args:
        boxes: f32[m, 9]; NaN velocities are unknown.
        labels, box_valid: i32[m] and bool[m].

    Returns:
        the sums of both losses f32[g] per group of classes, and counts to sum over the batch, with the number of
        boxes i32[g] per group.
    """
    groups = jnp.array(pillars.class_groups(len(config.classes)))
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


def make_sums(
    config: Config, pillars: PillarConfig, grid: Grid
) -> Callable[[Any, CentreOutputs, Any, Batch], Sums]:
    """Make the function from outputs and ground truth of a batch to the sums of its losses.

    The first and third argument, variables and pillars, have no influence.

    The loss of each group of classes is averaged over the group's own boxes: its sum is weighted so that the
    division by all boxes gives this average. With micro-batches this is exact for one group only, since the
    weights of several groups are computed per micro-batch.
    """

    def sums(_variables: Any, outputs: CentreOutputs, _pillars: Any, batch: Batch) -> Sums:
        parts, counts = jax.vmap(
            lambda *sample: sample_losses(*sample, config=config, pillars=pillars, grid=grid)
        )(outputs, batch.boxes, batch.labels, batch.box_valid)
        parts, counts = jax.tree.map(lambda leaf: leaf.sum(axis=0), (parts, counts))
        by_group = sum_over_devices(counts["positives"])
        share = jnp.maximum(by_group.sum(), 1) / jnp.maximum(by_group, 1)
        losses = {name: (part * share).sum() for name, part in parts.items()}
        means = {"positives": {"positive_iou": counts["iou_sum"]}}
        return Sums({"positives": losses}, {"positives": counts["positives"].sum()}, means)

    return sums
