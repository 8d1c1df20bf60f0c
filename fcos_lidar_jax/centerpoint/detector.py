"""CenterPoint as a :class:`fcos_lidar_jax.models.Detector`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.centerpoint.centres import decode_centres
from fcos_lidar_jax.centerpoint.network import CenterPoint
from fcos_lidar_jax.centerpoint.objective import make_sums
from fcos_lidar_jax.centerpoint.pillar_config import PillarConfig
from fcos_lidar_jax.centerpoint.pillars import Grid, make_pillars, pillar_grid
from fcos_lidar_jax.centerpoint.types import CentreOutputs, Pillars
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.initialization import init_variables
from fcos_lidar_jax.models import Detector, Variables
from fcos_lidar_jax.sensors import Sensor

_BEYOND_M = 10.0  # Maximum distance of a box outside the map, and maximum height or depth of its centre.


def build(config: Config, settings: PillarConfig, sensor: Sensor) -> Detector:
    """Build CenterPoint for the clouds of a sensor."""
    grid = pillar_grid(settings, sensor)
    cells = pillar_grid(settings, sensor, stride=settings.output_stride)
    network = CenterPoint(settings, settings.class_groups(len(config.classes)), grid.side)

    def prepare(points: Array | np.ndarray, valid: Array | np.ndarray) -> Pillars:
        return make_pillars(points, valid, grid=grid, sensor=sensor)

    def init(key: Any) -> Variables:
        features, cell = jax.ShapeDtypeStruct((1, 8, 10), jnp.float32), jax.ShapeDtypeStruct((1, 8), jnp.int32)
        pillars = Pillars(features, cell, jax.ShapeDtypeStruct((1,), jnp.int32))  # type: ignore[arg-type]
        return init_variables(network, key, pillars)

    def apply(variables: Variables, pillars: Pillars, *, train: bool = False) -> tuple[CentreOutputs, Any]:
        outputs, updates = network.apply(variables, pillars, train=train, mutable=["batch_stats"] if train else [])
        return outputs, updates["batch_stats"] if train else variables["batch_stats"]

    def candidates(outputs: CentreOutputs, pillars: Pillars) -> tuple[Array, Array, Array, Array]:
        boxes, scores, labels, valid = centre_candidates(outputs, config=config, pillars=settings, grid=cells)
        valid &= (pillars.cell < grid.num_cells).any()  # The heat map of nothing has peaks, too.
        return boxes, jnp.where(valid, scores, 0.0), labels, valid

    return Detector(prepare, init, apply, make_sums(config, settings, cells), candidates, config, sensor)


def centre_candidates(
    outputs: CentreOutputs, *, config: Config, pillars: PillarConfig, grid: Grid
) -> tuple[Array, Array, Array, Array]:
    """Select the best (cell, class) pairs of the heat map and decode their boxes.

    Boxes far outside the map are discarded.

    Args:
        outputs: predictions of one sample.
        config, pillars, grid: thresholds, counts and the cells of the heat map (static).

    Returns:
        boxes f32[c, 9], scores f32[c], labels i32[c], valid bool[c].
    """
    probability = jax.nn.sigmoid(outputs.heat)
    scores = jnp.where(probability > config.inference.min_probability, probability, -1.0).reshape(-1)
    score, pair = lax.top_k(scores, min(config.inference.candidates_per_level, scores.shape[0]))
    cell, label = pair // len(config.classes), (pair % len(config.classes)).astype(jnp.int32)
    group = jnp.array(pillars.class_groups(len(config.classes)))[label]
    regression = outputs.regression.reshape(-1, *outputs.regression.shape[-2:])[cell, group]
    boxes = decode_centres(regression, cell, grid)
    reach, centre = pillars.range_m + _BEYOND_M, np.asarray(grid.low_m) + pillars.range_m
    near = (jnp.abs(boxes[:, :2] - centre.astype(np.float32)) <= reach).all(axis=1) & (
        jnp.abs(boxes[:, 2]) <= _BEYOND_M
    )
    valid = (score >= 0) & near
    return boxes, jnp.where(valid, score, 0.0), label, valid
