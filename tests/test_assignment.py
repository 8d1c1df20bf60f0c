"""Compare owners and dynamic K with loops, on random and degenerate input."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.assignment import assign, owners


def f32(x):
    return jnp.asarray(x, jnp.float32)


def i32(x):
    return jnp.asarray(x, jnp.int32)


compute = jax.jit(assign, static_argnames=("num_boxes", "top_q"))


FORMS = pytest.mark.parametrize("form", ["loop", "reduction"])


@FORMS
@pytest.mark.parametrize("num_boxes", [1, 40])
def test_owners_of_overlapping_boxes_match_loops(num_boxes, form):
    rng = np.random.default_rng(num_boxes)
    boxes = oracles.random_boxes(rng, num_boxes, 4.0).astype(np.float32)
    points = (rng.normal(0, 4, (300, 3)) * [1, 1, 0.3]).astype(np.float32)
    present, valid = rng.random(300) < 0.9, rng.random(num_boxes) < 0.8
    actual = np.asarray(owners(points, present, boxes, valid, form=form))
    expected = [oracles.owner(p, boxes, valid) if here else -1 for p, here in zip(points, present, strict=True)]
    np.testing.assert_array_equal(actual, expected)
    assert num_boxes == 1 or max(sum(oracles.inside(p, b) for b in boxes) for p in points) >= 2


@FORMS
def test_owner_boundary_equal_volumes_and_padding(form):
    boxes = f32([[0, 0, 0, 2, 2, 2, 0], [0.5, 0, 0, 2, 2, 2, 0], [0, 0, 0, np.nan, 1, 1, 0]])
    points = f32([[1, 1, 1], [1.5, 0, 0], [0, 0, 0], [1.6, 0, 0], [0, 0, 0]])
    present = jnp.array([True, True, True, True, False])
    actual = owners(points, present, boxes, jnp.array([True, True, False]), form=form)
    assert actual.tolist() == [0, 1, 0, -1, -1]
    endless = f32([[0, 0, 0, np.inf, 2, 2, 0]])
    assert owners(points, present, endless, jnp.array([True]), form=form).tolist() == [-1] * 5
    for column in range(7):
        unknown = boxes[:1].at[0, column].set(jnp.nan)
        assert owners(points, present, unknown, jnp.array([True]), form=form).tolist() == [-1] * 5


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("num_boxes", [1, 100])
def test_assignment_matches_the_matrix_form(seed, num_boxes):
    rng = np.random.default_rng(seed)
    owner = rng.integers(-1, num_boxes, 2000).astype(np.int32)
    iou = (rng.random(2000) * (rng.random(2000) < 0.7)).astype(np.float32)
    cost = np.round(rng.random(2000) * 4, 1).astype(np.float32)  # many exact ties
    iou = np.round(iou * 4) / 4 if seed % 2 else iou  # sums of quarters include exact halves
    iou = iou.astype(np.float32)
    expected, ks = oracles.assign(owner, cost, iou, num_boxes, 20)
    targets = compute(i32(owner), f32(cost), f32(iou), num_boxes=num_boxes)
    np.testing.assert_array_equal(targets.num_positive, ks)
    np.testing.assert_array_equal(targets.positive, expected)


def test_without_candidates_and_with_one_candidate():
    none = compute(i32([-1] * 5), f32([0] * 5), f32([1] * 5), num_boxes=3)
    assert none.num_positive.tolist() == [0, 0, 0]
    assert not none.positive.any()
    one = compute(i32([1]), f32([9]), f32([0]), num_boxes=2)
    assert one.positive.tolist() == [True]
    assert one.num_positive.tolist() == [0, 1]


def test_without_boxes_or_locations():
    points, boxes = jnp.zeros((3, 3)), jnp.zeros((0, 7))
    for form in (None, "loop", "reduction"):
        assert owners(points, jnp.ones(3, bool), boxes, jnp.ones(0, bool), form=form).tolist() == [-1] * 3
    targets = assign(i32([]), f32([]), f32([]), num_boxes=2)
    assert targets.num_positive.tolist() == [0, 0]
    assert targets.positive.shape == (0,)


def test_a_diverged_prediction_ranks_last():
    targets = compute(i32([0, 0, 0]), f32([np.nan, 5, np.inf]), f32([0.0, 0.0, 0.0]), num_boxes=1)
    assert targets.positive.tolist() == [False, True, False]
    targets = compute(i32([0, 0, 0]), f32([1, 5, 2]), f32([np.nan, 0.9, 0.9]), num_boxes=1)  # without NaN, K is 2
    assert targets.positive.tolist() == [False, False, True]
