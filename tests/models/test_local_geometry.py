"""Local geometry: its definition in loops, its borders, and its place in the network."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR

from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.models.layers import EPSILON
from fcos_lidar_jax.models.local_geometry import (
    COLUMNS,
    HIDDEN,
    ROWS,
    UNIT_M,
    LocalGeometry,
    local_offsets,
    window,
)
from fcos_lidar_jax.types import CHANNELS

SHAPE = (2, 4, 9)
MEAN = (1.0, -2.0, -1.2, 12.0, 0.4, -0.2, 25.0, 0.0, 0.2)
SCALE = (11.0, 10.0, 1.2, 9.0, 1.7, 0.2, 22.0, 2.0, 0.15)


def image_of(rounds: int = 2, seed: int = 0):
    """A normalised image with gaps, and the points of its first round in metres (NaN where there are none)."""
    rng = np.random.default_rng(seed)
    exists = rng.random((*SHAPE, rounds)) < 0.7
    points = rng.uniform(-30, 30, (*SHAPE, 3, rounds))
    raw = np.zeros((*SHAPE, 9, rounds))
    raw[..., :3, :] = points
    raw[..., CHANNELS.index("azimuth"), :] = np.arctan2(points[..., 1, :], points[..., 0, :])
    raw[..., CHANNELS.index("existence"), :] = 1
    image = np.where(exists[..., None, :], (raw - np.array(MEAN)[:, None]) / np.array(SCALE)[:, None], 0)
    first = np.where(exists[..., :1], points[..., 0], np.nan)
    return jnp.asarray(image.reshape(*SHAPE, -1), jnp.float32), first


def by_loops(points, *, circular: bool):
    """The definition, pixel by pixel."""
    batch, height, width, _ = points.shape
    found = np.zeros((batch, height, width, 80))
    for b, i, j in np.ndindex(batch, height, width):
        own = points[b, i, j]
        turn = np.arctan2(own[1], own[0])
        radial, left = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
        k = 0
        for di in range(-ROWS, ROWS + 1):
            for dj in range(-COLUMNS, COLUMNS + 1):
                if di == dj == 0:
                    continue
                row, column = i + di, (j + dj) % width if circular else j + dj
                if 0 <= row < height and 0 <= column < width:
                    offset = points[b, row, column] - own
                    if np.isfinite(offset).all():
                        three = np.array([offset @ radial, offset @ left, offset[2]])
                        found[b, i, j, 4 * k : 4 * k + 4] = [*np.arcsinh(three / UNIT_M), 1]
                k += 1
    return found


@pytest.mark.parametrize("circular", [False, True])
@pytest.mark.parametrize("rounds", [1, 2])
def test_offsets_are_their_definition_in_loops_also_under_jit_and_vmap(circular, rounds):
    image, points = image_of(rounds)
    expected = by_loops(points, circular=circular)

    def compute(image):
        return local_offsets(image, mean=MEAN, scale=SCALE, circular=circular)

    np.testing.assert_allclose(compute(image), expected, atol=1e-3)
    np.testing.assert_allclose(jax.jit(compute)(image), expected, atol=1e-3)
    np.testing.assert_allclose(jax.vmap(compute)(image[:, None])[:, 0], expected, atol=1e-3)
    assert 0.2 < (expected[..., 3::4] == 1).mean() < 0.8
    assert len(window()) == 20


def test_features_are_two_layers_of_the_offsets():
    image, points = image_of()
    module = LocalGeometry(5, MEAN, SCALE)
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), image, train=False))
    rng = np.random.default_rng(1)
    variables = jax.tree.map(lambda leaf: jnp.asarray(rng.uniform(0.1, 1, leaf.shape), jnp.float32), shapes)
    variables["params"]["linear0"] -= 0.5
    x = by_loops(points, circular=False)
    for layer in range(2):
        p, s = variables["params"], variables["batch_stats"][f"norm{layer}"]
        y = x @ np.asarray(p[f"linear{layer}"], np.float64)
        norm = p[f"norm{layer}"]
        x = np.maximum((y - s["mean"]) / np.sqrt(s["var"] + EPSILON) * norm["scale"] + norm["bias"], 0)
    found = module.apply(variables, image, train=False)
    np.testing.assert_allclose(found, x, rtol=1e-3, atol=1e-2)
    assert variables["params"]["linear0"].shape == (80, HIDDEN)
    assert (x > 0).any()


@pytest.mark.parametrize("points", [0, 1])
def test_gradients_are_finite_where_nothing_is_near(points):
    image = np.zeros((1, 4, 9, 9), np.float32)
    image[0, 2, 4, [0, 1, 7]] = points
    module = LocalGeometry(5, MEAN, SCALE)
    variables = module.init(jax.random.key(0), jnp.asarray(image), train=False)

    def total(params, image):
        y, _ = module.apply({**variables, "params": params}, image, train=True, mutable=["batch_stats"])
        return (y**2).sum()

    gradients = jax.jit(jax.grad(total, argnums=(0, 1)))(variables["params"], jnp.asarray(image))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradients))


def test_it_is_added_to_the_stem_and_nothing_else_changes():
    plain = build_detector(CONFIG, SENSOR)
    model = dataclasses.replace(CONFIG.model, local_geometry=True)
    local = build_detector(dataclasses.replace(CONFIG, model=model), SENSOR)
    variables = local.init(jax.random.key(0))
    parts = count_parameters(variables["params"])
    width = CONFIG.model.stem.out_channels
    assert parts.pop("local_geometry") == 80 * HIDDEN + HIDDEN * width + 2 * (HIDDEN + width)
    assert parts.keys() == count_parameters(jax.eval_shape(plain.init, jax.random.key(0))["params"]).keys()
    rng = np.random.default_rng(0)
    features = rng.uniform(1, 5, (1, SENSOR.num_rows, SENSOR.num_columns, 9, CONFIG.projection.num_rounds))
    features = jnp.asarray(features, jnp.float32)
    apply = jax.jit(local.apply)
    found, _ = apply(variables, features)
    silent = jax.tree.map(lambda leaf: leaf, variables)
    silent["params"]["local_geometry"]["norm1"] = jax.tree.map(
        jnp.zeros_like, variables["params"]["local_geometry"]["norm1"]
    )
    without = {name: {k: v for k, v in tree.items() if k != "local_geometry"} for name, tree in variables.items()}
    expected, _ = jax.jit(plain.apply)(without, features)
    close = functools.partial(
        np.testing.assert_allclose, rtol=0, atol=1e-5
    )  # Another program may round otherwise.
    jax.tree.map(close, apply(silent, features)[0], expected)
    assert float(jnp.abs(found.logits - expected.logits).max()) > 0
