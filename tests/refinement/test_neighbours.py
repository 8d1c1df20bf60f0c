"""Neighbours of boxes against a loop over pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.refinement.network import REACH_M, find_neighbours

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
            np.testing.assert_allclose(found.features[i, slot], own, atol=2e-4)
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
