"""CenterPoint's network: published sizes, any order of the points, batches, empty clouds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_peer import CONFIG
from tiny_run import SENSOR, untrained

from fcos_lidar_jax.centerpoint.network import Neck, from_channels
from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT, CENTERPOINT_PILLARS, COMPACT
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training.plan import _initial_weights


@pytest.fixture(scope="module")
def scene():
    detector = build_detector(CONFIG, SENSOR)
    clouds = [make_cloud(make_frame(seed, SENSOR).points, CONFIG, sensor=SENSOR) for seed in (0, 1)]
    points, valid = (np.stack([getattr(cloud, name) for cloud in clouds]) for name in ("points", "valid"))
    valid[1, 500:] = False
    make = jax.jit(jax.vmap(detector.prepare))
    apply = jax.jit(detector.apply, static_argnames="train")
    return apply, jax.jit(detector.init)(jax.random.key(0)), make, points, valid


def sizes(config):
    shapes = jax.eval_shape(build_detector(config, NUSCENES_HDL32E).init, jax.random.key(0))
    return count_parameters(shapes["params"])


def test_the_networks_have_the_published_sizes():
    """By hand: layers of the published configuration, with biases where a batch norm does not follow."""
    ours = sizes(CENTERPOINT_PILLARS)
    assert ours["points"] == 10 * 32 + 2 * 32 + 64 * 64 + 2 * 64
    stages = [(64, 64, 3), (64, 128, 5), (128, 256, 5)]
    assert ours["backbone"] == sum(9 * a * b + 2 * b + n * (9 * b * b + 2 * b) for a, b, n in stages)
    assert ours["neck"] == 64 * 4 * 128 + 128 * 128 + 256 * 4 * 128 + 3 * 2 * 128
    hidden, shared = 9 * 64 * 64 + 2 * 64, 9 * 384 * 64 + 2 * 64
    assert ours["heads"] == shared + 6 * 6 * hidden + 6 * (9 * 64 + 1) * 10 + (9 * 64 + 1) * 10
    assert 300_000 < sizes(CENTERPOINT_COMPACT)["total"] < sizes(COMPACT)["total"] < 2_100_000


def test_outputs_do_not_depend_on_the_order_or_on_the_rest_of_the_batch(scene):
    apply, variables, make, points, valid = scene
    outputs, statistics = apply(variables, make(points, valid))
    assert outputs.heat.shape == (2, 32, 32, 10)
    assert outputs.regression.shape == (2, 32, 32, 1, 10)
    assert statistics is not None
    order = np.random.default_rng(0).permutation(points.shape[1])
    shuffled, _ = apply(variables, make(points[:, order], valid[:, order]))
    alone = [apply(variables, make(points[i : i + 1], valid[i : i + 1]))[0] for i in (0, 1)]
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *alone)
    for other in (shuffled, joined):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), outputs, other)
    assert float(jnp.abs(outputs.heat[0] - outputs.heat[1]).max()) > 1e-4


def test_statistics_use_only_valid_points(scene):
    """Padding changes nothing, nor do points that are dropped."""
    apply, variables, make, points, valid = scene
    kept = apply(variables, make(points[1:, :500], valid[1:, :500]), train=True)
    padded = apply(variables, make(points[1:], valid[1:]), train=True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), kept, padded)
    features = np.asarray(make(points, valid).features)[np.asarray(valid)]
    features = features[np.abs(features).sum(axis=1) > 0]
    linear = features @ np.asarray(variables["params"]["points"]["linear0"]["kernel"])[0, 0]
    _, statistics = apply(variables, make(points, valid), train=True)
    found = statistics["points"]["norm0"]
    np.testing.assert_allclose(found["mean"], 0.1 * linear.mean(axis=0), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found["var"], 0.9 + 0.1 * linear.var(axis=0), rtol=1e-3)


def test_an_empty_cloud_has_finite_outputs_and_statistics(scene):
    apply, variables, make, points, _ = scene
    nothing = make(points, np.zeros(points.shape[:2], bool))
    for train in (False, True):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(apply(variables, nothing, train=train)))


def test_each_class_is_predicted_by_its_group():
    groups = (0, 1, 0, 2, 1, 0, 2, 1, 0, 1)
    config = dataclasses.replace(CONFIG, pillars=dataclasses.replace(CONFIG.pillars, groups=groups))  # type: ignore[type-var]
    detector = build_detector(config, SENSOR)
    variables = untrained(config, SENSOR)
    heads = variables["params"]["heads"]
    for group in range(3):  # nothing but the biases
        for name in ("heat", "offset", "height", "size", "heading", "velocity"):
            part = heads[f"group{group}_{name}"]
            part[f"{name}_kernel"] = jnp.zeros_like(part[f"{name}_kernel"])
            part[f"{name}_bias"] = 10.0 * group + jnp.arange(part[f"{name}_bias"].shape[0])
    shapes = jax.eval_shape(detector.prepare, np.zeros((9, 5), np.float32), np.zeros(9, bool))
    pillars = jax.tree.map(lambda leaf: jnp.zeros((1, *leaf.shape), leaf.dtype), shapes)
    outputs, _ = jax.jit(detector.apply)(variables, pillars)
    seen = {g: [k for k in range(10) if groups[k] == g] for g in range(3)}
    expected = [10.0 * groups[k] + seen[groups[k]].index(k) for k in range(10)]
    np.testing.assert_allclose(outputs.heat[0, 3, 4], expected)
    assert outputs.regression[0, 3, 4, 2].tolist() == [20, 21, 20, 20, 21, 22, 20, 21, 20, 21]


def test_the_neck_is_strided_convolutions():
    """Levels at strides 2, 4 and 8 to stride 4: a 2x2 convolution, a 1x1 and a transposed 2x2."""
    rng = np.random.default_rng(0)
    levels = [jnp.array(rng.normal(size=(1, s, s, c)), jnp.float32) for s, c in ((8, 3), (4, 5), (2, 6))]
    neck = Neck(7, 4)
    variables = neck.init(jax.random.key(0), levels, train=False)
    found = neck.apply(variables, levels, train=False)
    kernels = [np.asarray(variables["params"][f"level{i}_conv"]["kernel"])[0, 0] for i in range(3)]
    expected = np.zeros((4, 4, 21))
    for i in range(4):
        for j in range(4):
            square = np.asarray(levels[0])[0, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].reshape(-1)
            upper = (np.asarray(levels[2])[0, i // 2, j // 2] @ kernels[2]).reshape(2, 2, 7)
            row = [square @ kernels[0], np.asarray(levels[1])[0, i, j] @ kernels[1], upper[i % 2, j % 2]]
            expected[i, j] = np.maximum(np.concatenate(row) / np.sqrt(1 + 1e-5), 0)
    np.testing.assert_allclose(found[0], expected, atol=1e-5)
    assert from_channels(jnp.zeros((1, 2, 2, 28)), 2).shape == (1, 4, 4, 7)


def test_points_are_taken_in_full_float32_precision(scene):
    apply, variables, make, points, valid = scene
    program = apply.lower(variables, make(points, valid)).as_text().splitlines()
    products = [line for line in program if "stablehlo.dot_general" in line]
    full = [line for line in products if "HIGHEST" in line]
    assert len(full) == 1 < len(products)
    assert "x10xf32>, tensor<10x" in full[0]  # the ten features of the points
    assert not any("HIGHEST" in line for line in program if "stablehlo.convolution" in line)


def test_weights_of_other_pillars_are_reported(tmp_path, capsys):
    save_checkpoint(tmp_path / "other", Checkpoint(CONFIG, SENSOR, untrained(CONFIG, SENSOR), 1))
    half = dataclasses.replace(CONFIG.pillars, range_m=12.8, pillar_m=0.4)
    _initial_weights(build_detector(dataclasses.replace(CONFIG, pillars=half), SENSOR), tmp_path / "other")
    told = capsys.readouterr().err
    assert "weights of pillars.pillar_m 0.8, to be trained with 0.4\n" in told
    assert "weights of pillars.range_m 25.6, to be trained with 12.8\n" in told
