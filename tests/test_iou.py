"""Compare rotated IoU with Shapely, closed forms and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.iou import rotated_iou_3d, rotated_iou_bev

NUMBER = 20_000
IDENTICAL = slice(5000, 6000)
FEW = 1_000  # in derivatives
# Share the jitted functions between tests: jax.jit of a new derivative compiles again.
VALUE = {f: jax.jit(f) for f in (rotated_iou_3d, rotated_iou_bev)}
GRADIENT = jax.jit(jax.grad(lambda a, b: rotated_iou_3d(a, b).sum(), argnums=(0, 1)))
TANGENT = jax.jit(lambda a, b, da, db: jax.jvp(rotated_iou_3d, (a, b), (da, db))[1])


def of_few(function, *arrays):
    """The function of a few pairs, in a shape for which it is compiled once."""
    number = len(arrays[0])
    padded = [np.concatenate([a, np.zeros((FEW - number, 7))]).astype(np.float32) for a in arrays]
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:number], function(*padded))


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


@pytest.fixture(scope="module")
def few(pairs):
    """Every twentieth pair."""
    return [part[:: NUMBER // FEW] for part in pairs]


@pytest.mark.parametrize(("function", "vertical"), [(rotated_iou_3d, True), (rotated_iou_bev, False)])
def test_matches_shapely_on_20000_pairs(pairs, function, vertical):
    expected = oracles.iou(*pairs, vertical=vertical)
    found = np.asarray(VALUE[function](*pairs))
    assert np.abs(found - expected).max() < 3e-6
    assert found.min() >= 0
    assert found.max() <= 1 + 1e-6


def test_float32_gradients_equal_float64_and_finite_differences(few):
    """At the kink of identical boxes, there is no difference to compare with."""
    single = GRADIENT(*few)
    with jax.enable_x64(True):
        a, b = (jnp.asarray(part, jnp.float64) for part in few)
        double = GRADIENT(a, b)
        steps, value = 1e-6 * np.eye(7), VALUE[rotated_iou_3d]
        differences = [np.asarray(value(a + s, b) - value(a - s, b)) / 2e-6 for s in steps]
    for one, other in zip(single, double, strict=True):
        assert np.abs(np.asarray(one) - np.asarray(other)).max() < 1e-4
    regular = (few[0] != few[1]).any(axis=1)
    assert 0 < (~regular).sum() < FEW / 10
    assert np.abs(np.asarray(double[0]) - np.stack(differences, 1))[regular].max() < 1e-4


def test_gradients_in_the_ground_plane_are_those_of_boxes_of_one_height(few):
    a, b = (part[:40] * [1, 1, 0, 1, 1, 0, 1] + [0, 0, 0, 0, 0, 1, 0] for part in few)
    gradient = jax.jit(jax.grad(lambda a, b: rotated_iou_bev(a, b).sum()))
    flat = np.array([1, 1, 0, 1, 1, 0, 1])
    np.testing.assert_allclose(gradient(few[0][:40], few[1][:40]), flat * of_few(GRADIENT, a, b)[0], atol=1e-5)


def test_forward_mode_is_the_gradient_along_a_direction(few):
    directions = np.random.default_rng(2).normal(0, 0.3, (2, FEW, 7)).astype(np.float32)
    expected = sum(np.einsum("nc,nc->n", g, d) for g, d in zip(GRADIENT(*few), directions, strict=True))
    np.testing.assert_allclose(TANGENT(*few, *directions), expected, rtol=1e-5, atol=1e-5)
    assert np.abs(expected).max() > 0.1


def test_gradients_of_batches_are_those_of_their_pairs_and_broadcast_ones_are_summed(few):
    """Boxes with eight others each, nearly equal and identical ones, under vmap."""
    a, b = (part[240:280].reshape(5, 8, 7) for part in few)
    one, others = a[:, 0], a[:, :1] + (b - a)
    total, each = jax.vmap(GRADIENT)(one, others)
    single = of_few(GRADIENT, np.repeat(one, 8, axis=0), others.reshape(-1, 7))
    np.testing.assert_allclose(total, single[0].reshape(5, 8, 7).sum(axis=1), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(each, single[1].reshape(5, 8, 7), rtol=1e-5, atol=1e-5)


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


def test_degenerate_pairs_have_their_iou_and_small_gradients():
    a, b, expected = (np.array(part) for part in zip(*DEGENERATE.values(), strict=True))
    for values in (of_few(VALUE[rotated_iou_3d], a, b), of_few(VALUE[rotated_iou_3d], b, a)):
        np.testing.assert_allclose(values, expected, atol=1e-5, err_msg=str(list(DEGENERATE)))
    reverse = np.concatenate(of_few(GRADIENT, a, b), axis=1)
    assert np.abs(reverse).max() < 1e3
    units = np.tile(np.eye(14)[:, None], (1, len(a), 1))
    forward = np.stack([of_few(TANGENT, a, b, unit[:, :7], unit[:, 7:]) for unit in units], axis=1)
    largest = np.abs(reverse).max(axis=1, keepdims=True)
    assert (np.abs(forward - reverse) <= 2e-5 * np.maximum(1, largest)).all()


def test_a_box_with_nan_has_iou_0():
    """Except for z and h, which do not matter in the ground plane."""
    box = np.tile(np.array([0, 0, 0, 4, 2, 1, 0.0]), (7, 1))
    bad = np.where(np.eye(7, dtype=bool), np.nan, box)
    for pair in ((box, bad), (bad, box)):
        assert of_few(VALUE[rotated_iou_bev], *pair).tolist() == [0, 0, 1, 0, 0, 1, 0]
        assert of_few(VALUE[rotated_iou_3d], *pair).tolist() == [0] * 7


def test_broadcasting_and_vmap_match_loops(pairs):
    a, b = pairs[0][:6], pairs[1][:5]
    found = jax.jit(jax.vmap(rotated_iou_bev, (0, None)))(a, b)
    loops = of_few(VALUE[rotated_iou_bev], np.repeat(a, 5, axis=0), np.tile(b, (6, 1))).reshape(6, 5)
    np.testing.assert_allclose(found, loops, atol=1e-6)
