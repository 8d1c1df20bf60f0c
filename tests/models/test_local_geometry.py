"""Local geometry: its definition in loops, its borders, and its place in the network."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.locations import STRIDES
from fcos_lidar_jax.models.heads import Head, Heads
from fcos_lidar_jax.models.layers import EPSILON
from fcos_lidar_jax.models.local_geometry import (
    COLUMNS,
    HIDDEN,
    ROWS,
    UNIT_M,
    LocalGeometry,
    local_offsets,
    round_offsets,
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
    raw[..., 8, :] = rng.uniform(0, 0.5, (*SHAPE, rounds))
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


@pytest.mark.parametrize(("circular", "rounds"), [(False, 1), (True, 2)])
def test_offsets_are_their_definition_in_loops_also_under_jit_and_vmap(circular, rounds):
    image, points = image_of(rounds)
    expected = by_loops(points, circular=circular)

    def compute(image):
        return local_offsets(image, mean=MEAN, scale=SCALE, circular=circular)

    np.testing.assert_allclose(jax.jit(compute)(image), expected, atol=1e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(compute))(image[:, None])[:, 0], expected, atol=1e-4)
    assert 0.2 < (expected[..., 3::4] == 1).mean() < 0.8
    assert len(window()) == 20


def later_by_loops(image, rounds: int):
    """Offsets to the later rounds by their definition, pixel by pixel."""
    raw = np.asarray(image, np.float64).reshape(*SHAPE, 9, rounds)
    found = np.zeros((*SHAPE, rounds - 1, 5))
    for place in np.ndindex(*SHAPE):
        both = raw[place][CHANNELS.index("existence")] > 0
        points = raw[place][:3] * np.array(SCALE)[:3, None] + np.array(MEAN)[:3, None]
        turn = np.arctan2(points[1, 0], points[0, 0])
        for r in range(1, rounds):
            if both[0] and both[r]:
                dx, dy, dz = points[:, r] - points[:, 0]
                radial, left = np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx
                lag = raw[place][8, r] - raw[place][8, 0]
                found[(*place, r - 1)] = [*np.arcsinh(np.array([radial, left, dz]) / UNIT_M), lag, 1]
    return found.reshape(*SHAPE, -1)


@pytest.mark.parametrize("rounds", [1, 3])
def test_offsets_between_rounds_are_their_definition_in_loops(rounds):
    image = image_of(rounds)[0]

    def compute(image):
        return round_offsets(image, mean=MEAN, scale=SCALE)

    expected = later_by_loops(image, rounds)
    assert expected.shape[-1] == 5 * (rounds - 1)
    np.testing.assert_allclose(jax.jit(compute)(image), expected, atol=1e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(compute))(image[:, None])[:, 0], expected, atol=1e-4)
    if rounds > 1:
        assert 0.2 < (expected[..., 4::5] == 1).mean() < 0.8
        assert len(np.unique(expected[..., 3::5])) > 9


def test_features_are_two_layers_of_the_offsets_and_of_the_points_own_numbers():
    image, points = image_of(rounds=2)
    module = LocalGeometry(5, MEAN, SCALE)
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), image, train=False))
    rng = np.random.default_rng(1)
    variables = jax.tree.map(lambda leaf: jnp.asarray(rng.uniform(0.1, 1, leaf.shape), jnp.float32), shapes)
    variables["params"]["linear0"] -= 0.5
    names = "z", "range", "inclination", "intensity", "existence"
    own = np.stack([image[..., 2 * CHANNELS.index(name)] for name in names], axis=-1)
    x = np.concatenate([by_loops(points, circular=False), own], axis=-1)
    for layer in range(2):
        p, s = variables["params"], variables["batch_stats"][f"norm{layer}"]
        y = x @ np.asarray(p[f"linear{layer}"], np.float64)
        norm = p[f"norm{layer}"]
        x = np.maximum((y - s["mean"]) / np.sqrt(s["var"] + EPSILON) * norm["scale"] + norm["bias"], 0)
    found = module.apply(variables, image, train=False)
    np.testing.assert_allclose(found, x, rtol=1e-5, atol=1e-4)
    assert variables["params"]["linear0"].shape == (85, HIDDEN)
    assert (x > 0).any()


def test_gradients_are_finite_where_nothing_is_near():
    module = LocalGeometry(5, MEAN, SCALE, later_rounds=True)
    images = np.zeros((2, 1, 4, 9, 18), np.float32)
    images[1, 0, 2, 4, [0, 2, 14]] = 1  # nothing at all, and a single point
    variables = jax.jit(lambda image: module.init(jax.random.key(0), image, train=False))(images[0])

    def total(params, image):
        y, _ = module.apply({**variables, "params": params}, image, train=True, mutable=["batch_stats"])
        return (y**2).sum()

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))
    for image in images:
        gradients = gradient(variables["params"], image)
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradients))


@pytest.mark.parametrize("tied", [False, True])
def test_it_joins_the_heads_of_every_level_and_nothing_else_changes(tied):
    rng = np.random.default_rng(0)
    shapes = [(1, 8 // stride or 1, 16 // stride or 1, 8) for stride in STRIDES[:4]]
    levels, local = ([jnp.asarray(rng.uniform(size=shape), jnp.float32) for shape in shapes] for _ in range(2))
    heads = Heads(3, 8, 1, 0.9, tied=tied)
    params = jax.jit(heads.init)(jax.random.key(0), levels, local)["params"]
    assert len(params) == (1 if tied else len(levels))
    plain = {
        head: {name: part for name, part in parts.items() if not name.endswith("_local")}
        for head, parts in params.items()
    }
    apply = jax.jit(heads.apply)
    expected = apply({"params": plain}, levels)
    silent = apply({"params": params}, levels, jax.tree.map(jnp.zeros_like, local))
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-5), silent, expected)
    found, first = apply({"params": params}, levels, local), 0
    for _, height, width, _ in shapes:
        level = slice(first, first + height * width)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert float(jnp.abs(a[:, level] - b[:, level]).max()) > 0
        first = level.stop


def test_a_location_is_given_the_features_of_its_own_pixel():
    head = Head(2, 8, 1, 0.9)
    rng = np.random.default_rng(0)
    image, local = (jnp.asarray(rng.uniform(size=(1, 6, 8, 8)), jnp.float32) for _ in range(2))
    variables = head.init(jax.random.key(0), image, local)
    towers = jax.tree.map(jnp.zeros_like, variables["params"])  # Only what joins behind the towers is left.
    for name in ("classification", "regression"):
        towers[f"{name}_local"] = variables["params"][f"{name}_local"]
    kernel = np.zeros((3, 3, 8, 3), np.float32)
    kernel[1, 1] = rng.normal(size=(8, 3))
    towers["classification"] = {"logits_kernel": jnp.asarray(kernel), "logits_bias": jnp.zeros(3)}
    found = head.apply({"params": towers}, image, local).logits
    joined = np.maximum(np.asarray(local) @ np.asarray(towers["classification_local"]["kernel"][0, 0]), 0)
    np.testing.assert_allclose(found, (joined @ kernel[1, 1]).reshape(1, -1, 3), rtol=1e-4, atol=1e-5)
