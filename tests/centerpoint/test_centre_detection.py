"""CenterPoint's candidates and boxes against loops."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_peer import CONFIG
from tiny_run import SENSOR

from fcos_lidar_jax.centerpoint import CenterPointConfig, PillarConfig
from fcos_lidar_jax.centerpoint.centres import decode_centres
from fcos_lidar_jax.centerpoint.detector import centre_candidates
from fcos_lidar_jax.centerpoint.pillars import Grid
from fcos_lidar_jax.centerpoint.types import CentreOutputs
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.simulation.frames import make_frame

GRID = Grid(12, 1.0, (-6.0, -6.0))
SMALL = CenterPointConfig(
    classes=("a", "b", "c"),
    pillars=PillarConfig(range_m=6.0, pillar_m=0.5, output_stride=2, groups=(0, 1, 0)),
    inference=InferenceConfig(min_probability=0.3, candidates_per_level=90, max_detections=20),
)


@pytest.fixture(scope="module")
def outputs():
    rng = np.random.default_rng(0)
    regression = rng.normal(0, 0.7, (12, 12, 2, 10))
    regression[3, 4, :, 0], regression[5, 6, :, 2] = 40.0, -11.0  # far beside, far below
    return CentreOutputs(jnp.float32(rng.normal(0, 2, (12, 12, 3))), jnp.float32(regression))


def test_candidates_are_the_best_pairs_of_cell_and_class_also_under_vmap(outputs):
    def find(o):
        return centre_candidates(o, config=SMALL, pillars=SMALL.pillars, grid=GRID)

    two = jax.tree.map(lambda leaf: jnp.stack([leaf[::-1], leaf]), outputs)
    boxes, scores, labels, valid = (np.asarray(leaf)[1] for leaf in jax.jit(jax.vmap(find))(two))
    p = 1 / (1 + np.exp(-np.asarray(outputs.heat, np.float64)))
    pairs = sorted((-p[i, j, k], i * 12 + j, k) for i, j, k in np.ndindex(12, 12, 3) if p[i, j, k] > 0.3)[:90]
    assert 0 < valid.sum() < len(pairs)
    for slot, (score, cell, label) in enumerate(pairs):
        numbers = outputs.regression[cell // 12, cell % 12, (0, 1, 0)[label]]
        expected = np.asarray(decode_centres(numbers, jnp.int32(cell), GRID))
        near = (np.abs(expected[:2]) <= 16).all() and abs(expected[2]) <= 10
        assert valid[slot] == near
        assert (labels[slot], scores[slot]) == (label, pytest.approx(-score if near else 0, abs=1e-6))
        np.testing.assert_allclose(boxes[slot], expected, atol=1e-6)


@pytest.mark.slow
def test_points_to_boxes_and_of_nothing():
    detector = build_detector(dataclasses.replace(CONFIG, max_points=4096), SENSOR)
    variables, detect = jax.jit(detector.init)(jax.random.key(0)), jax.jit(make_detect(detector))
    points = make_frame(0, SENSOR).points
    every = np.ones(len(points), bool)
    assert detect(variables, points, every).valid.any()
    for nothing in (detect(variables, points, ~every), detect(variables, points * np.nan, every)):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(nothing))
        assert not nothing.valid.any()
