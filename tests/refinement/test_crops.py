"""The points of each box against a loop, and the choice among too many points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.refinement import crops
from fcos_lidar_jax.refinement.crops import crop_points

OPTIONS = {"num_points": 24, "margin_m": 0.5}
crop = jax.jit(crop_points, static_argnames=("num_points", "margin_m"))


def cloud(seed: int, number: int = 1000):
    rng = np.random.default_rng(seed)
    points = np.c_[rng.normal(size=(number, 3)) * [6, 6, 1], rng.uniform(0, 255, number), rng.random(number)]
    boxes = np.c_[oracles.random_boxes(rng, 12, 6.0), np.zeros((12, 2))]
    boxes[0, :3], boxes[1, 3] = 500.0, 80.0  # far from all points; longer than the limit
    return points.astype(np.float32), rng.random(number) < 0.9, boxes.astype(np.float32)


def in_frame(points, box):
    """Positions in the frame of a box."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    dx, dy, dz = (points[:, :3] - box[:3]).T
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, dz], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_points_equal_a_loop_over_boxes(seed):
    points, valid, boxes = cloud(seed)
    points[::50, 2] = np.nan
    found = jax.device_get(crop(points, valid, boxes, **OPTIONS))
    for box, local, index, count in zip(boxes, found.points, found.index, found.count, strict=True):
        half = np.minimum(box[3:6], 25) / 2 + 0.5
        inside = np.flatnonzero((np.abs(in_frame(points, box)) < half).all(axis=1) & valid)
        taken = index[index >= 0]
        assert count == len(inside)
        assert len(set(taken)) == len(taken) == min(count, 24)
        assert set(taken) <= set(inside)
        np.testing.assert_allclose(local[: len(taken), :3], in_frame(points[taken], box), atol=2e-5)
        np.testing.assert_array_equal(local[: len(taken), 3:], points[taken, 3:])
        assert not local[len(taken) :].any()
    assert found.count.max() > 24
    assert found.count[0] == 0


def test_the_choice_depends_only_on_the_points():
    points, valid, boxes = cloud(3)
    found = crop(points, valid, boxes, **OPTIONS)
    order = np.random.default_rng(0).permutation(len(points))
    more = np.concatenate([points[order], points[:77] + 1])
    other = crop(more, np.concatenate([valid[order], np.zeros(77, bool)]), boxes, **OPTIONS)
    np.testing.assert_array_equal(other.points, found.points)
    np.testing.assert_array_equal(np.append(order, -1)[other.index], found.index)


def test_both_zeros_are_the_same_under_jit():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (32, 5)).astype(np.float32)
    points[:, 1] = 0
    valid, boxes = jnp.ones(32, bool), jnp.array([[0, 0, 0, 4, 4, 4, 0, 0, 0]], jnp.float32)
    signed = points.copy()
    signed[::2, 1] = -0.0
    points, signed = jnp.asarray(points), jnp.asarray(signed)
    expected = crop(points, valid, boxes, num_points=4, margin_m=0.5).index
    for find in (crop, crop_points):
        found = find(signed, valid, boxes, num_points=4, margin_m=0.5)
        np.testing.assert_array_equal(found.index, expected)


def test_the_choice_is_not_biased():
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 5)).astype(np.float32)
    found = crop(points, np.ones(4000, bool), np.array([[0, 0, 0, 2, 2, 2, 0.0]]), num_points=1000, margin_m=0.1)
    assert found.valid.all()
    # Standard error of the mean of 1,000 uniform values: 0.018.
    assert np.abs(np.asarray(found.points[0]).mean(axis=0)).max() < 0.07


def test_batches_equal_their_samples():
    clouds = [cloud(seed) for seed in range(2)]
    both = jax.jit(jax.vmap(functools.partial(crop_points, **OPTIONS)))(*map(np.stack, zip(*clouds, strict=True)))
    for i, one in enumerate(clouds):
        expected = crop(*one, **OPTIONS)
        np.testing.assert_array_equal(both.index[i], expected.index)
        np.testing.assert_allclose(both.points[i], expected.points, atol=2e-5)


def test_both_sorts_give_the_same_order():
    high, low = map(jnp.asarray, np.random.default_rng(0).integers(0, 2**32, (2, 5000), np.uint32))
    np.testing.assert_array_equal(crops._by_word(high, low), crops._by_columns(high, low))


@pytest.mark.parametrize("number", [0, 1, 31, 33])
def test_all_points_are_found_if_they_do_not_fill_a_word(number):
    points = np.tile(np.float32([1, 2, 3, 4, 5]), (number, 1))
    box = np.array([[1, 2, 3, 1, 1, 1, 0.0]])
    found = crop(points, np.ones(number, bool), box, **OPTIONS)
    assert found.count.tolist() == [number]
    assert int(found.valid.sum()) == min(number, 24)


def test_gradients_are_finite_without_points():
    points, _, boxes = cloud(0)

    def total(points, boxes):
        return crop_points(points, jnp.zeros(len(points), bool), boxes, **OPTIONS).points.sum()

    for gradient in jax.jit(jax.grad(total, argnums=(0, 1)))(points, boxes):
        assert np.isfinite(gradient).all()
