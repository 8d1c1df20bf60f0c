"""Rotated IoU against Shapely, closed forms and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.iou import oriented_iou_3d, rotated_iou_3d, rotated_iou_bev

NUMBER = 20_000
IDENTICAL = slice(5000, 6000)


@pytest.fixture(scope="module")
def pairs():
    """Random, nearly equal and identical pairs, up to 50 m from the origin, as float32."""
    rng = np.random.default_rng(0)
    a, b = oracles.random_boxes(rng, NUMBER), oracles.random_boxes(rng, NUMBER)
    b[:5000] = a[:5000] + rng.normal(0, 0.05, (5000, 7))
    b[IDENTICAL] = a[IDENTICAL]
    b[:, 3:6] = np.abs(b[:, 3:6])
    offset = rng.uniform(-50, 50, (NUMBER, 2))
    a[:, :2] += offset
    b[:, :2] += offset
    return a.astype(np.float32), b.astype(np.float32)


@pytest.mark.parametrize(("function", "vertical"), [(rotated_iou_3d, True), (rotated_iou_bev, False)])
def test_equals_shapely_on_20000_pairs(pairs, function, vertical):
    expected = oracles.iou(*pairs, vertical=vertical)
    error = np.abs(np.asarray(jax.jit(function)(*pairs)) - expected).max()
    print(f"\n{function.__name__}: largest error {error:.2e}, {(expected > 0).sum()} pairs overlap")
    assert error < 1e-5
    assert np.abs(np.asarray(function(*pairs)) - expected).max() < 1e-5


def gradients(function, a, b):
    return jax.jit(jax.grad(lambda a, b: function(a, b).sum(), argnums=(0, 1)))(a, b)


@pytest.mark.parametrize("function", [rotated_iou_3d, rotated_iou_bev])
def test_float32_gradients_equal_float64_and_finite_differences(pairs, function):
    single = [np.asarray(g) for g in gradients(function, *pairs)]
    assert all(np.isfinite(g).all() for g in single)
    with jax.enable_x64(True):
        a, b = (jnp.asarray(p, jnp.float64) for p in pairs)
        double = [np.asarray(g) for g in gradients(function, a, b)]
        value = jax.jit(function)
        step = 1e-6
        differences = np.stack(
            [(value(a.at[:, k].add(step), b) - value(a.at[:, k].add(-step), b)) / (2 * step) for k in range(7)], 1
        )
    regular = np.ones(NUMBER, bool)
    regular[IDENTICAL] = False  # a kink: there is no derivative to compare with
    error = max(np.abs(s - d).max() for s, d in zip(single, double, strict=True))
    against = np.abs(double[0] - differences)[regular].max()
    print(f"\n{function.__name__}: float32 against float64 {error:.1e}, against differences {against:.1e}")
    assert error < 1e-3
    assert against < 1e-4


def tangents(function, a, b, da, db):
    return jax.jit(lambda *boxes: jax.jvp(function, boxes, (da, db))[1])(a, b)


@pytest.mark.parametrize("function", [rotated_iou_3d, rotated_iou_bev])
def test_forward_mode_equals_float64_and_finite_differences(pairs, function):
    rng = np.random.default_rng(2)
    directions = rng.normal(0, 1, (NUMBER, 14))
    directions = np.split((directions / np.linalg.norm(directions, axis=1)[:, None]).astype(np.float32), 2, axis=1)
    single = np.asarray(tangents(function, *pairs, *directions))
    with jax.enable_x64(True):
        a, b, da, db = (jnp.asarray(p, jnp.float64) for p in (*pairs, *directions))
        double = np.asarray(tangents(function, a, b, da, db))
        value, step = jax.jit(function), 1e-6
        after, before = value(a + step * da, b + step * db), value(a - step * da, b - step * db)
        differences = np.asarray(after - before) / (2 * step)
    regular = np.ones(NUMBER, bool)
    regular[IDENTICAL] = False
    against = np.abs(double - differences)[regular].max()
    error = np.abs(single - double).max()
    print(f"\n{function.__name__}: float32 against float64 {error:.1e}, against differences {against:.1e}")
    assert error < 1e-3
    assert against < 1e-4


@pytest.mark.parametrize("function", [rotated_iou_3d, rotated_iou_bev])
def test_forward_and_reverse_mode_agree_also_mapped(pairs, function):
    pairs = [jnp.asarray(p[4900:5200]) for p in pairs]  # nearly equal and identical ones
    forward, reverse = (
        jax.jit(jax.vmap(jacobian(function, argnums=(0, 1))))(*pairs) for jacobian in (jax.jacfwd, jax.jacrev)
    )
    for one, other in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    alone = [jax.jacfwd(function)(a, b) for a, b in zip(pairs[0][98:102], pairs[1][98:102], strict=True)]
    np.testing.assert_allclose(forward[0][98:102], alone, rtol=1e-4, atol=1e-5)
    assert float(jnp.abs(forward[0]).max()) > 0.1


BASE = [1, 2, 0, 4, 2, 1.5, 0.3]
DEGENERATE = {
    "equal": (BASE, BASE, 1.0),
    "turned by pi": (BASE, [*BASE[:6], 0.3 + np.pi], 1.0),
    "contained": ([0, 0, 0, 4, 2, 1, 0], [0, 0, 0, 1, 1, 1, 0.5], 1 / 8),
    "touching along an edge": ([0, 0, 0, 4, 2, 1, 0], [4, 0, 0, 4, 2, 1, 0], 0.0),
    "touching at a corner": ([0, 0, 0, 4, 2, 1, 0], [4, 2, 0, 4, 2, 1, 0], 0.0),
    "touching in height": ([0, 0, 0, 4, 2, 1, 0], [0, 0, 1, 4, 2, 1, 0], 0.0),
    "collinear edges": ([0, 0, 0, 4, 2, 1, 0], [1, 0, 0, 4, 2, 1, 0], 3 / 5),
    "half inside, edges collinear": ([0, 0, 0, 4, 2, 1, 0], [1, 0, 0, 2, 2, 1, 0], 1 / 2),
    "square by 90 degrees": ([0, 0, 0, 2, 2, 1, 0], [0, 0, 0, 2, 2, 1, np.pi / 2], 1.0),
    "square by 45 degrees": ([0, 0, 0, 2, 2, 1, 0], [0, 0, 0, 2, 2, 1, np.pi / 4], 2**-0.5),
    "crossed": ([0, 0, 0, 4, 1, 1, 0], [0, 0, 0, 4, 1, 1, np.pi / 2], 1 / 7),
    "disjoint": (BASE, [90, *BASE[1:]], 0.0),
    "one without size": ([0, 0, 0, 0, 0, 0, 0], BASE, 0.0),
    "both without size": ([0] * 7, [0] * 7, 0.0),
    "one without width": ([1, 2, 0, 4, 0, 1.5, 0.3], BASE, 0.0),
    "huge": ([1e3, 0, 0, 4e3, 2e3, 1e3, 0], [2e3, 0, 0, 4e3, 2e3, 1e3, 0], 3 / 5),
    "far away": ([1e3, 1e3, 0, 4, 2, 1, 0], [1e3 + 1, 1e3, 0, 4, 2, 1, 0], 3 / 5),
    "tiny": ([0, 0, 0, 4e-2, 2e-2, 1e-2, 0], [1e-2, 0, 0, 4e-2, 2e-2, 1e-2, 0], 3 / 5),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_pairs(name):
    a, b, expected = DEGENERATE[name]
    a, b = jnp.array(a, jnp.float32), jnp.array(b, jnp.float32)
    value, gradient = jax.jit(jax.value_and_grad(rotated_iou_3d, argnums=(0, 1)))(a, b)
    assert abs(float(value) - expected) < 1e-5
    assert abs(float(rotated_iou_3d(b, a)) - expected) < 1e-5
    assert all(bool(jnp.isfinite(g).all()) for g in gradient)
    assert max(float(jnp.abs(g).max()) for g in gradient) < 1e3
    forward = jax.jit(jax.jacfwd(rotated_iou_3d, argnums=(0, 1)))(a, b)
    for one, other in zip(forward, gradient, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5 * max(1.0, float(jnp.abs(other).max())))


def test_broadcasts_and_maps_like_loops(pairs):
    a, b = jnp.asarray(pairs[0][:6]), jnp.asarray(pairs[1][:5])
    matrix = rotated_iou_bev(a[:, None], b[None])
    loops = np.array([[float(rotated_iou_bev(x, y)) for y in b] for x in a])
    np.testing.assert_allclose(matrix, loops, atol=1e-6)
    mapped = jax.vmap(rotated_iou_3d)(a[:5], b)
    np.testing.assert_allclose(mapped, rotated_iou_3d(a[:5], b), atol=1e-6)


def test_broadcast_gradients_are_summed():
    box = jnp.array(BASE, jnp.float32)
    others = jnp.asarray(oracles.random_boxes(np.random.default_rng(1), 8, 1.0), jnp.float32)
    total = jax.grad(lambda x: rotated_iou_3d(x, others).sum())(box)
    single = sum(jax.grad(lambda x, o=o: rotated_iou_3d(x, o))(box) for o in others)
    np.testing.assert_allclose(total, single, atol=1e-5)


def test_oriented_form_needs_no_angle():
    a = jnp.array([1, 2, 0, 4, 2, 1.5, np.cos(0.3), np.sin(0.3)], jnp.float32)
    b = jnp.array([1.5, 2, 0, 4, 2, 1.5, np.cos(0.5), np.sin(0.5)], jnp.float32)
    expected = oracles.iou([[1, 2, 0, 4, 2, 1.5, 0.3]], [[1.5, 2, 0, 4, 2, 1.5, 0.5]], vertical=True)
    np.testing.assert_allclose(oriented_iou_3d(a, b), expected[0], atol=1e-6)
