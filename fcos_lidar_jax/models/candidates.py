"""Selection of candidates for NMS from the predictions of FCOS-LiDAR (paper, section 3.4)."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.coding import Axes, decode
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.locations import ImageLayout
from fcos_lidar_jax.types import Locations, Outputs


def select_candidates(
    outputs: Outputs,
    locations: Locations,
    *,
    config: InferenceConfig,
    layout: ImageLayout,
    axes: Axes,
) -> tuple[Array, Array, Array, Array]:
    """Select the best (location, class) pairs of each level and decode their boxes.

    A pair needs a point in its cell and a class probability above the threshold, before the IoU factor.

    Args:
        config, layout: thresholds, counts and sizes (static).
        axes: axes of the regression, see :mod:`fcos_lidar_jax.coding` (static).

    Returns:
        boxes f32[c, 9], scores f32[c], labels i32[c], valid bool[c].

    >>> layout = ImageLayout(rows=32, columns=32, row_upscale=1)
    >>> l = layout.num_locations
    >>> first = jnp.arange(l) == 0  # the only location with a point
    >>> seen = Locations(jnp.zeros((l, 3)), jnp.zeros(l), jnp.zeros(l, int), first)
    >>> outputs = Outputs(jnp.zeros((l, 2)), jnp.zeros((l, 10, 1)), jnp.zeros((l, 1)))
    >>> options = {"config": InferenceConfig(), "layout": layout, "axes": "lidar"}
    >>> boxes, scores, labels, valid = select_candidates(outputs, seen, **options)
    >>> scores[valid].tolist()  # probability 0.5, IoU 0.5
    [0.25]
    """
    num_classes = outputs.iou_logits.shape[-1]
    probability = jax.nn.softmax(outputs.logits)[:, :num_classes]
    eligible = (probability > config.min_probability) & locations.occupied[:, None]
    quality = jax.nn.sigmoid(outputs.iou_logits) ** config.iou_exponent
    scores = jnp.where(eligible, probability * quality, -1.0)
    pairs_per_level, first = [], 0
    for size in layout.level_sizes:
        best, index = _best_pairs(scores[first : first + size], config.candidates_per_level)
        pairs_per_level.append((best, index + first * num_classes))
        first += size
    score, pair = (jnp.concatenate(values) for values in zip(*pairs_per_level, strict=True))
    location, label = pair // num_classes, (pair % num_classes).astype(jnp.int32)
    regression = outputs.regression[location, :, label]
    boxes = decode(regression, locations.points[location], locations.azimuth_rad[location], axes=axes)
    valid = score >= 0
    return boxes, jnp.where(valid, score, 0.0), label, valid


def _best_pairs(scores: Array, number: int) -> tuple[Array, Array]:
    """``lax.top_k`` of the flattened scores f32[l, k]; ties are broken by index.

    The best n pairs belong to the n locations with the best maximum scores, so only these are sorted.
    """
    num_locations, num_classes = scores.shape
    _, best = lax.top_k(scores.max(axis=1), min(number, num_locations))
    best = jnp.sort(best)  # Keeps ties in the order of their index.
    score, index = lax.top_k(scores[best].reshape(-1), min(number, len(best) * num_classes))
    return score, best[index // num_classes] * num_classes + index % num_classes
