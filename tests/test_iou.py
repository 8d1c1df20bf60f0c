"""Compare rotated IoU with Shapely, closed forms and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.iou import oriented_iou_3d, rotated_iou_3d, rotated_iou_bev

NUMBER = 20_000
IDENTICAL = slice(5000, 6000)
BOTH = pytest.mark.parametrize("function", [rotated_iou_3d, rotated_iou_bev])
# Share the jitted functions between tests: jax.jit of a new derivative compiles again.
VALUE = {f: jax.jit(f) for f in (rotated_iou_3d, rotated_iou_bev)}
GRADIENT = {f: jax.jit(jax.grad(lambda a, b, f=f: f(a, b).sum(), argnums=(0, 1))) for f in VALUE}
TANGENT = {f: jax.jit(lambda a, b, da, db, f=f: jax.jvp(f, (a, b), (da, db))[1]) for f in VALUE}
FORWARD = {f: jax.jit(jax.jacfwd(f, argnums=(0, 1))) for f in VALUE}


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
def test_matches_shapely_on_20000_pairs(pairs, function, vertical):
    expected = oracles.iou(*pairs, vertical=vertical)
    for compute in (VALUE[function], function):
        assert np.abs(np.asarray(compute(*pairs)) - expected).max() < 1e-5


def in_float64(*arrays):
    return [jnp.asarray(array, jnp.float64) for array in arrays]


def central_difference(function, a, b, da, db, step=1e-6):
    after, before = (VALUE[function](a + s * da, b + s * db) for s in (step, -step))
    return np.asarray(after - before) / (2 * step)


def assert_close(single, double, differences):
    """Compare float32 with float64, and float64 with differences except at the kink of identical boxes."""
    regular = np.ones(NUMBER, bool)
    regular[IDENTICAL] = False
    assert max(np.abs(s - d).max() for s, d in zip(single, double, strict=True)) < 1e-3
    assert np.abs(double[0] - differences)[regular].max() < 1e-4


@BOTH
def test_float32_gradients_equal_float64_and_finite_differences(pairs, function):
    single = [np.asarray(g) for g in GRADIENT[function](*pairs)]
    assert all(np.isfinite(g).all() for g in single)
    with jax.enable_x64(True):
        a, b = in_float64(*pairs)
        double = [np.asarray(g) for g in GRADIENT[function](a, b)]
        differences = [central_difference(function, a, b, axis, 0.0) for axis in np.eye(7)]
    assert_close(single, double, np.stack(differences, 1))


@BOTH
def test_forward_mode_equals_float64_and_finite_differences(pairs, function):
    directions = np.random.default_rng(2).normal(0, 1, (NUMBER, 14))
    directions = np.split((directions / np.linalg.norm(directions, axis=1)[:, None]).astype(np.float32), 2, axis=1)
    single = np.asarray(TANGENT[function](*pairs, *directions))
    with jax.enable_x64(True):
        arguments = in_float64(*pairs, *directions)
        double = np.asarray(TANGENT[function](*arguments))
        differences = central_difference(function, *arguments)
    assert_close([single], [double], differences)


@BOTH
def test_forward_and_reverse_mode_agree_under_vmap(pairs, function):
    pairs = [jnp.asarray(p[4900:5200]) for p in pairs]  # nearly equal and identical pairs
    reverse = jax.jacrev(function, argnums=(0, 1))
    forward, reverse = (jax.jit(jax.vmap(jacobian))(*pairs) for jacobian in (FORWARD[function], reverse))
    for one, other in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
    alone = [FORWARD[function](a, b)[0] for a, b in zip(pairs[0][98:102], pairs[1][98:102], strict=True)]
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
    value, gradient = VALUE[rotated_iou_3d], GRADIENT[rotated_iou_3d](a, b)
    assert abs(float(value(a, b)) - expected) < 1e-5
    assert abs(float(value(b, a)) - expected) < 1e-5
    assert all(bool(jnp.isfinite(g).all()) for g in gradient)
    assert max(float(jnp.abs(g).max()) for g in gradient) < 1e3
    for one, other in zip(FORWARD[rotated_iou_3d](a, b), gradient, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5 * max(1.0, float(jnp.abs(other).max())))


def test_a_box_with_nan_has_iou_0():
    """Except for z and h, which do not matter in the ground plane."""
    box = np.array([0, 0, 0, 4, 2, 1, 0], np.float32)
    bad = np.where(np.eye(7, dtype=bool), np.nan, box).astype(np.float32)
    for compute in (rotated_iou_bev, VALUE[rotated_iou_bev]):
        assert compute(box, bad).tolist() == compute(bad, box).tolist() == [0, 0, 1, 0, 0, 1, 0]
    for compute in (rotated_iou_3d, VALUE[rotated_iou_3d]):
        assert compute(box, bad).tolist() == compute(bad, box).tolist() == [0] * 7


def test_broadcasting_and_vmap_match_loops(pairs):
    a, b = jnp.asarray(pairs[0][:6]), jnp.asarray(pairs[1][:5])
    bev, in_space = VALUE[rotated_iou_bev], VALUE[rotated_iou_3d]
    loops = np.array([[float(bev(x, y)) for y in b] for x in a])
    np.testing.assert_allclose(bev(a[:, None], b[None]), loops, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(rotated_iou_3d))(a[:5], b), in_space(a[:5], b), atol=1e-6)


def test_broadcast_gradients_are_summed():
    box = jnp.array(BASE, jnp.float32)
    others = jnp.asarray(oracles.random_boxes(np.random.default_rng(1), 8, 1.0), jnp.float32)
    gradient = GRADIENT[rotated_iou_3d]
    total, single = gradient(box, others)[0], sum(gradient(box, other)[0] for other in others)
    np.testing.assert_allclose(total, single, atol=1e-5)


def test_oriented_iou_matches_shapely():
    a = jnp.array([1, 2, 0, 4, 2, 1.5, np.cos(0.3), np.sin(0.3)], jnp.float32)
    b = jnp.array([1.5, 2, 0, 4, 2, 1.5, np.cos(0.5), np.sin(0.5)], jnp.float32)
    expected = oracles.iou([[1, 2, 0, 4, 2, 1.5, 0.3]], [[1.5, 2, 0, 4, 2, 1.5, 0.5]], vertical=True)
    np.testing.assert_allclose(oriented_iou_3d(a, b), expected[0], atol=1e-6)
