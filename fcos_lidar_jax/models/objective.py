"""Assignment and losses of FCOS-LiDAR, as sums."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax import losses
from fcos_lidar_jax.assignment import assign, owners
from fcos_lidar_jax.coding import Axes, decode_oriented, encode
from fcos_lidar_jax.config import Config, LossConfig
from fcos_lidar_jax.iou import oriented, oriented_iou_3d
from fcos_lidar_jax.locations import ImageLayout, image_layout, locate
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Batch, Locations, Outputs, RangeImage, Sums, Targets

_REGRESSION = ("l1", "iou", "iou_prediction")  # the paper's losses of the locations that regress a box


def location_owners(image: RangeImage, locations: Locations, boxes: Array, box_valid: Array) -> Array:
    """Find the box that owns each location of one sample, -1 for none.

    Each cell of the sensor's image is tested once: repeated rows and coarser levels have the same points.
    """
    first = image.features[..., 0].reshape(-1, image.features.shape[-2])
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
    axes: Axes,
) -> tuple[dict[str, tuple[Array, Array]], Targets, dict[str, Array]]:
    """Assign targets and compute the losses of one sample (paper, section 3.4).

    Args:
        boxes: f32[m, 9]; NaN velocities are unknown.
        labels, box_valid: i32[m] and bool[m].
        config, layout: weights, options and sizes (static).
        axes: axes of the regression, see :mod:`fcos_lidar_jax.coding` (static).

    Returns:
        the four losses as (sum, count), the targets, and counts to sum over the batch.
    """
    background = outputs.logits.shape[-1] - 1
    locations = locate(image, layout)
    owner = location_owners(image, locations, boxes, box_valid)
    owned = jnp.maximum(owner, 0)
    box, label = boxes[owned], labels[owned]

    regression = jnp.take_along_axis(outputs.regression, label[:, None, None], axis=2)[..., 0]
    iou_logit = jnp.take_along_axis(outputs.iou_logits, label[:, None], axis=1)[:, 0]
    # Locations without an owner get a harmless box, so that nothing overflows before it is masked.
    box = jnp.where((owner >= 0)[:, None], box, jnp.array([0, 0, 0, 1, 1, 1, 0, 0, 0], jnp.float32))
    predicted = decode_oriented(regression, locations.points, locations.azimuth_rad, axes=axes)
    truth = oriented(box)
    iou = oriented_iou_3d(lax.stop_gradient(predicted), truth)
    cost = losses.cross_entropy(lax.stop_gradient(outputs.logits), label)
    targets = assign(owner, cost, iou, num_boxes=boxes.shape[0], top_q=config.top_q)
    positive = targets.positive
    regressed = positive if config.regress_on == "positives" else owner >= 0
    quality = iou if config.quality == "iou" else losses.centreness(predicted, truth, config.centreness_m)
    with jax.named_scope("losses"):
        label = jnp.where(positive, label, background)
        target = encode(box, locations.points, locations.azimuth_rad, axes=axes)
        parts = {
            "classification": losses.classification_loss(outputs.logits, label, locations.occupied),
            "l1": losses.l1_loss(regression, target, regressed, velocity_weight=config.velocity_weight),
            "iou": losses.iou_loss(predicted, truth, regressed, kind=config.iou_loss),
            "iou_prediction": losses.iou_prediction_loss(iou_logit, quality, regressed),
        }
    levels = jnp.split(positive, np.cumsum(layout.level_sizes)[:-1])
    cells = jnp.zeros(layout.rows * layout.columns + 1, bool)
    cells = cells.at[jnp.where(positive, locations.cell, -1)].set(True)
    counts = {
        "positives": positive.sum(dtype=jnp.int32),
        "unique_positives": cells[:-1].sum(dtype=jnp.int32),
        "candidates": (owner >= 0).sum(dtype=jnp.int32),
        "owned_boxes": (targets.num_positive > 0).sum(dtype=jnp.int32),
        "iou_sum": jnp.where(positive, iou, 0.0).sum(),
        "positives_per_level": jnp.stack([level.sum(dtype=jnp.int32) for level in levels]),
    }
    return parts, targets, counts


def make_sums(config: Config, sensor: Sensor) -> Callable[[Any, Outputs, RangeImage, Batch], Sums]:
    """Make the function from outputs, range images and ground truth of a batch to the sums of its losses.

    Its first argument, the variables, has no influence.
    """
    options: dict[str, Any] = {"layout": image_layout(sensor, config.model), "axes": config.model.regression_axes}
    losses_of = functools.partial(sample_losses, config=config.loss, **options)

    def sums(_: Any, outputs: Outputs, images: RangeImage, batch: Batch) -> Sums:
        pairs, _, counts = jax.vmap(losses_of)(outputs, images, batch.boxes, batch.labels, batch.box_valid)
        parts = {name: pair[0] for name, pair in pairs.items()}
        parts, counts = jax.tree.map(lambda leaf: leaf.sum(axis=0), (parts, counts))
        by_count = {"positives": {"classification": parts["classification"]}}
        # The order of the sums decides how they are rounded.
        for name in (*_REGRESSION, *sorted(parts.keys() - {"classification", *_REGRESSION})):
            by_count.setdefault(config.loss.regress_on, {})[name] = parts[name]
        iou_sum = counts.pop("iou_sum")
        means = {"positives": {"positive_iou": iou_sum}, "owned_boxes": {"mean_k": counts["positives"]}}
        return Sums(by_count, counts, means)

    return sums
