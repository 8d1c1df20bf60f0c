"""Features of points and boxes, and neighbours of boxes, against loops."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.refinement.network import REACH_M, box_features, find_neighbours, point_features
from fcos_lidar_jax.refinement.types import Crops

K = 5
find = jax.jit(find_neighbours, static_argnums=4)


def scene(seed: int):
    rng = np.random.default_rng(seed)
    boxes = oracles.random_boxes(rng, 30, 12.0).astype(np.float32)
    scores, labels = rng.random(30).astype(np.float32), rng.integers(0, 3, 30).astype(np.int32)
    return boxes, scores, labels, rng.random(30) < 0.8


def features(own, other, scores, same):
    """How one box lies to another."""
    turn = other[6] - own[6]
    axes = np.array([[np.cos(own[6]), np.sin(own[6])], [-np.sin(own[6]), np.cos(own[6])]])
    along, left = axes @ (other[:2] - own[:2])
    own_logit, logit = np.log(scores / (1 - scores))
    place = np.arcsinh([along, left, other[2] - own[2]])
    return [*place, np.cos(turn), np.sin(turn), same, (logit - own_logit) / 4, *np.log(other[3:6] / own[3:6])]


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_equal_a_loop(seed):
    boxes, scores, labels, valid = (x.astype(np.float64) if x.dtype == np.float32 else x for x in scene(seed))
    found = jax.device_get(find(*scene(seed), K))
    full = 0
    for i in range(30):
        distance = np.hypot(*(boxes[:, :2] - boxes[i, :2]).T)
        near = [j for j in np.argsort(distance) if valid[j] and j != i and distance[j] < REACH_M][:K]
        assert found.index[i][found.valid[i]].tolist() == near
        full += len(near) == K
        for slot, j in enumerate(near):
            own = features(boxes[i], boxes[j], scores[[i, j]], labels[i] == labels[j])
            np.testing.assert_allclose(found.features[i, slot], own, atol=5e-6)
        assert not found.features[i, len(near) :].any()
    assert 0 < full < 30


def test_batches_equal_their_samples_and_gradients_are_finite():
    scenes = [scene(seed) for seed in range(2)]
    both = jax.jit(jax.vmap(lambda *one: find_neighbours(*one, K)))(*map(np.stack, zip(*scenes, strict=True)))
    for i, one in enumerate(scenes):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], both)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), own, find(*one, K))
    none = jnp.zeros((3, 9)), jnp.zeros(3), jnp.zeros(3, int), jnp.ones(3, bool)  # all at one place
    total = jax.grad(
        lambda boxes, scores: find_neighbours(boxes, scores, *none[2:], K).features.sum(), argnums=(0, 1)
    )
    assert all(np.isfinite(g).all() for g in total(*none[:2]))
    assert find(*(x[:1] for x in none), K).valid.tolist() == [[False]]
    assert find(*(x[:0] for x in none), K).index.shape == (0, 0)


def test_features_of_points_equal_a_loop():
    rng, boxes = np.random.default_rng(0), scene(0)[0]
    points, index = rng.normal(0, 3, (30, 4, 5)).astype(np.float32), rng.integers(-1, 9, (30, 4)).astype(np.int32)
    boxes[0, 3] = 80.0  # only the limit is seen
    crops = Crops(jnp.asarray(points), jnp.asarray(index), jnp.zeros(30, jnp.int32))
    found = jax.jit(point_features)(crops, boxes)
    for box, slot in np.ndindex(30, 4):
        place, half = points[box, slot, :3].astype(np.float64), np.minimum(boxes[box, 3:6], 25) / 2
        _, _, _, intensity, lag = points[box, slot]
        own = [*place, *(place + half), *(half - place), intensity / 255, *np.arcsinh(place / 0.2), lag]
        np.testing.assert_allclose(found[box, slot], np.array(own) * (index[box, slot] >= 0), atol=1e-5)
    one = jax.tree.map(lambda leaf: leaf[None], (crops, jnp.asarray(boxes)))
    np.testing.assert_allclose(jax.vmap(point_features)(*one)[0], found, atol=1e-5)


@pytest.mark.parametrize("with_velocity", [False, True])
def test_features_of_boxes_equal_a_loop(with_velocity):
    boxes, scores, labels, _ = scene(1)
    boxes = np.c_[boxes, np.random.default_rng(0).normal(0, 9, (30, 2))].astype(np.float32)
    count = np.arange(30, dtype=np.int32)

    def features(*arrays):
        return box_features(*arrays, 3, with_velocity=with_velocity)

    found = jax.jit(features)(boxes, scores, labels, count)
    for i, (x, y, _, l, w, h, yaw, vx, vy) in enumerate(boxes.astype(np.float64)):
        turn, axes = yaw - np.arctan2(y, x), np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        own = [*np.eye(3)[labels[i]], np.log(scores[i] / (1 - scores[i])), np.log(l), np.log(w), np.log(h)]
        own += [np.hypot(x, y) / 30, np.log(1 + i) / 4, np.sin(turn), np.cos(turn)]
        own += [*(axes @ [vx, vy] / 10)] if with_velocity else []
        np.testing.assert_allclose(found[i], own, atol=1e-5)
    each = jax.vmap(lambda *one: features(*(x[None] for x in one))[0])(boxes, scores, labels, count)
    np.testing.assert_allclose(each, found, atol=1e-5)
    others = [jnp.asarray(part) for part in (scores, labels, count)]
    gradient = jax.grad(lambda b: features(b, *others).sum())(0 * jnp.asarray(boxes))
    assert np.isfinite(gradient).all()
