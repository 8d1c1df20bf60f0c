"""Targets of the second look against a loop over boxes and objects."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tiny_run

from fcos_lidar_jax.refinement import stage
from fcos_lidar_jax.refinement.targets import encode_residual, match_boxes, move_boxes
from fcos_lidar_jax.refinement.types import LookInputs, RefinementTargets

OPTIONS = {"num_classes": 3, "radius_range_m": (1.0, 2.0), "between_weight": 0.25}
match = jax.jit(match_boxes, static_argnames=(*OPTIONS, "with_velocity"))


def scene(seed: int):
    rng = np.random.default_rng(seed)
    truth = oracles.random_boxes(rng, 8, 5.0).astype(np.float32)
    boxes = truth[rng.integers(0, 8, 40)] + rng.normal(0, 1.2, (40, 7)).astype(np.float32)
    boxes[:, 3:6] = np.maximum(np.abs(boxes[:, 3:6]), 0.3)
    labels, true_labels = (rng.integers(0, 3, n).astype(np.int32) for n in (40, 8))
    return boxes, labels, rng.random(40) < 0.9, truth, true_labels, rng.random(8) < 0.9


def expected(boxes, labels, valid, truth, true_labels, true_valid):
    """Labels, owners and weights by loops."""
    label, owner, weight = np.full(len(boxes), 3), np.full(len(boxes), -1), valid.astype(float)
    radius = np.clip(truth[:, 3:5].max(axis=1) / 2, 1, 2)
    best = {}
    for i in np.flatnonzero(valid):
        distance = np.hypot(*(truth[:, :2] - boxes[i, :2]).T)
        near = [j for j in np.flatnonzero(true_valid) if distance[j] < radius[j]]
        if near:
            cost, owner[i] = min(((labels[i] != true_labels[j], distance[j]), j) for j in near)
            best[owner[i]] = min(best.get(owner[i], (cost, i)), (cost, i))
        elif (distance < 2 * radius)[true_valid].any():
            weight[i] = 0.25
    for j, (_, i) in best.items():
        label[i] = true_labels[j]
    return label, owner, weight


@pytest.mark.parametrize("with_velocity", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_targets_equal_a_loop(seed, with_velocity):
    arrays = list(scene(seed))
    if with_velocity:
        rng = np.random.default_rng(seed)
        velocities = {i: rng.normal(0, 9, (len(arrays[i]), 2)).astype(np.float32) for i in (0, 3)}
        velocities[3][::3] = np.nan  # unknown
        arrays = [np.hstack([a, velocities[i]]) if i in velocities else a for i, a in enumerate(arrays)]
    targets = jax.device_get(match(*arrays, **OPTIONS, with_velocity=with_velocity))
    label, owner, weight = expected(*arrays)
    np.testing.assert_array_equal(targets.label, label)
    np.testing.assert_array_equal(targets.near, owner >= 0)
    np.testing.assert_allclose(targets.weight, weight)
    boxes, truth = arrays[0], arrays[3]
    moved = np.asarray(move_boxes(jnp.asarray(boxes), jnp.asarray(targets.residual)))[owner >= 0]
    own = truth[owner[owner >= 0]]
    np.testing.assert_allclose(moved[:, :3], own[:, :3], atol=2e-6)
    np.testing.assert_allclose(np.cos(moved[:, 6] - own[:, 6]), 1, atol=1e-5)
    np.testing.assert_allclose(moved[:, 7:], own[:, 7:], atol=1e-4)
    assert np.isnan(targets.residual).any() == with_velocity
    assert not targets.residual[owner < 0].any()
    assert (label < 3).sum() > 3
    assert 0.25 in weight


def test_without_boxes_or_objects_everything_is_background():
    boxes, labels, valid, *truth = map(jnp.asarray, scene(0))
    none = jnp.zeros((0, 7)), jnp.zeros(0, jnp.int32), jnp.zeros(0, bool)
    alone = match(boxes, labels, valid, *none, **OPTIONS)
    assert (alone.label == 3).all()
    assert not alone.near.any()
    np.testing.assert_array_equal(alone.weight, valid)
    assert match(*none, *truth, **OPTIONS).label.shape == (0,)


def test_residuals_are_coded_in_the_frame_of_the_box():
    box = np.array([[3.0, 4, 5, 4, 2, 1, np.pi / 2, 7, 8]], np.float32)
    target = np.array([[2.0, 6, 5.5, 8, 2, 0.5, np.pi, 0, 0]], np.float32)
    box, target = map(jnp.asarray, (box, target))
    residual = encode_residual(box, target)
    place_and_size = [2, 1, 0.5, np.log(2), 0, -np.log(2)]
    np.testing.assert_allclose(residual, [[*place_and_size, -8, 7, 1, 0]], atol=1e-6)
    still = encode_residual(box, target[:, :7])  # without velocities
    np.testing.assert_allclose(still, [[*place_and_size, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(move_boxes(box, still)[0, 7:], [7, 8])
    # Sizes change by at most a factor of e.
    np.testing.assert_allclose(move_boxes(box, residual.at[0, 3].set(5.0))[0, 3], 4 * np.e, rtol=1e-6)


def test_gradients_are_finite_for_degenerate_boxes():
    def total(a, b, residual):
        labels, valid = jnp.zeros(3, int), jnp.ones(3, bool)
        matched = match_boxes(a, labels, valid, b, labels, valid, **OPTIONS).residual
        return encode_residual(a, b).sum() + move_boxes(a, residual).sum() + matched.sum()

    boxes, gradient = jnp.zeros((3, 9)), jax.jit(jax.grad(total, argnums=(0, 1, 2)))
    for size in (8, 10):
        assert all(np.isfinite(g).all() for g in gradient(boxes, boxes, jnp.zeros((3, size))))


def test_losses_are_weighted_sums_over_boxes(monkeypatch):
    rng, config = np.random.default_rng(0), dataclasses.replace(tiny_run.REFINED, num_sweeps=2)
    kinds = len(config.classes)
    logits, residual, wanted = (rng.normal(0, 2, (2, 6, n)).astype(np.float32) for n in (kinds + 1, 10, 10))
    wanted[0, :3, 6:8] = np.nan  # unknown velocities
    label, near = rng.integers(0, kinds + 1, (2, 6)), rng.random((2, 6)) < 0.6
    label[0, :2] = logits[0, :2].argmax(axis=-1)
    weight = rng.choice(np.float32([0, 0.3, 1]), (2, 6))
    weight[0, 0] = 1
    monkeypatch.setattr(stage, "look", lambda *_: (jnp.asarray(logits), jnp.asarray(residual)))
    targets = RefinementTargets(*map(jnp.asarray, (label.astype(np.int32), wanted, near, weight)))
    unused = LookInputs(jnp.zeros((2, 6, 1, 14)), jnp.zeros((2, 6, 1), bool), jnp.zeros((2, 6, 1)), None)
    sums = stage.look_sums(config, {}, unused, targets)
    entropy = distance = right = 0.0
    for place in np.ndindex(2, 6):
        odds = np.exp(logits[place].astype(np.float64))
        entropy -= weight[place] * np.log(odds[label[place]] / odds.sum())
        off = np.abs(residual[place].astype(np.float64) - wanted[place])
        off[6:8] *= config.loss.velocity_weight
        distance += near[place] * np.nansum(off)
        right += (weight[place] > 0) * (odds.argmax() == label[place])
    np.testing.assert_allclose(sums.losses["refined_boxes"]["refined_class"], entropy, rtol=1e-5)
    np.testing.assert_allclose(sums.losses["refined_near"]["refined_box"], distance, rtol=1e-5)
    counts = (weight > 0).sum(), near.sum(), (label < kinds).sum()
    assert tuple(map(int, sums.counts.values())) == counts
    assert float(sums.means["refined_boxes"]["refined_accuracy"]) == right > 0

    def total(residual):
        monkeypatch.setattr(stage, "look", lambda *_: (jnp.asarray(logits), residual))
        return stage.look_sums(config, {}, unused, targets).losses["refined_near"]["refined_box"]

    gradient = jax.grad(total)(jnp.asarray(residual))
    assert np.isfinite(gradient).all()
    assert not gradient[0, :3, 6:8].any()


def test_scores_are_of_the_class_of_each_box(monkeypatch):
    config = dataclasses.replace(tiny_run.REFINED, refinement=dataclasses.replace(tiny_run.LOOK, move_boxes=False))
    logits = np.random.default_rng(0).normal(0, 2, (3, len(config.classes) + 1)).astype(np.float32)
    monkeypatch.setattr(stage, "look", lambda *_: (jnp.asarray(logits), jnp.zeros((3, 8))))
    place = np.zeros((3, 9), np.float32)
    place[:, 0], place[:, 3:6], labels = [5, 10, 15], 1, np.array([3, 0, 7], np.int32)
    cloud, boxes = (np.zeros((4, 5), np.float32), np.zeros(4, bool)), (place, np.float32([0.9, 0.8, 0.7]), labels)
    given = map(jnp.asarray, (*cloud, *boxes, np.ones(3, bool)))
    found, scores, found_labels, _ = stage.refine_boxes(
        stage.make_network(config), config, tiny_run.SENSOR, {}, *given
    )
    odds = np.exp(logits.astype(np.float64))
    expected = odds[range(3), labels] / odds.sum(axis=1)
    order = np.argsort(-expected)
    np.testing.assert_allclose(scores[:3], expected[order], rtol=1e-5)
    assert found_labels[:3].tolist() == labels[order].tolist()
    np.testing.assert_array_equal(found[:3], place[order])
