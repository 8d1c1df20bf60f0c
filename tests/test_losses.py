"""Compare each loss with NumPy, and check that losses and gradients are finite."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.config import LossConfig
from fcos_lidar_jax.iou import oriented
from fcos_lidar_jax.losses import (
    centreness,
    classification_loss,
    cross_entropy,
    iou_loss,
    iou_prediction_loss,
    l1_loss,
    weighted,
)

NUMBER = 50
KINDS = ("iou", "log_iou", "giou", "diou")


@functools.partial(jax.jit, static_argnums=3)
def iou_gradient(prediction, target, mask, kind):
    """Return ((sum, count), gradient by the prediction)."""

    def loss(prediction):
        total, count = iou_loss(prediction, target, mask, kind=kind)
        return total, (total, count)

    gradient, actual = jax.grad(loss, has_aux=True)(prediction)
    return actual, gradient


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def f32(x):
    return jnp.asarray(x, jnp.float32)


def test_classification_is_the_cross_entropy_over_the_mask(rng):
    logits, labels, mask = rng.normal(0, 3, (NUMBER, 11)), rng.integers(0, 11, NUMBER), rng.random(NUMBER) < 0.6
    total, count = classification_loss(f32(logits), jnp.asarray(labels, jnp.int32), jnp.asarray(mask))
    p = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    np.testing.assert_allclose(total, -np.log(p[np.arange(NUMBER), labels])[mask].sum(), rtol=1e-5)
    assert int(count) == mask.sum()


def test_masked_logits_do_not_change_the_classification_loss(rng):
    logits, labels = f32(rng.normal(0, 3, (NUMBER, 11))), jnp.asarray(rng.integers(0, 11, NUMBER), jnp.int32)
    mask = jnp.asarray(rng.random(NUMBER) < 0.6)

    def without_care(logits):
        return jnp.where(mask, cross_entropy(logits, labels), 0.0).sum()

    def loss(logits):
        return classification_loss(logits, labels, mask)[0]

    diverged = logits.at[~mask].set(f32(rng.choice([np.nan, np.inf, -np.inf, 1e38], (int((~mask).sum()), 11))))
    value, gradient = jax.jit(jax.value_and_grad(without_care))(logits)
    compute = jax.jit(jax.value_and_grad(loss))
    for given in (logits, diverged):
        actual = compute(given)
        assert actual[0] == value
        np.testing.assert_array_equal(actual[1], gradient)
    assert not np.asarray(gradient)[~mask].any()


def test_l1_weights_velocities_and_skips_unknown_ones(rng):
    prediction, target = rng.normal(0, 1, (2, NUMBER, 10))
    target[::3, 8:] = np.nan
    target[1, 9] = np.nan
    mask = rng.random(NUMBER) < 0.6

    def loss(prediction):
        total, count = l1_loss(prediction, f32(target), jnp.asarray(mask), velocity_weight=0.2)
        return total, count

    (total, count), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(f32(prediction))
    expected = np.nansum(np.abs(prediction - target) * ([1] * 8 + [0.2] * 2), axis=1)[mask].sum()
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    assert int(count) == mask.sum()
    assert np.isfinite(gradient).all()
    assert not np.asarray(gradient)[~mask].any()
    assert not np.asarray(gradient)[::3, 8:].any()


def pairs(rng):
    a = oracles.random_boxes(rng, NUMBER)
    b = a + rng.normal(0, 0.2, a.shape)
    b[:, 3:6] = np.abs(b[:, 3:6]) + 0.1
    b[:5, 0] += 50  # disjoint
    return a, b


@pytest.mark.parametrize("kind", KINDS)
def test_iou_losses_match_shapely_and_corners(rng, kind):
    a, b = pairs(rng)
    mask = rng.random(NUMBER) < 0.8
    iou = oracles.iou(a, b, vertical=True)
    unions = (a[:, 3:6].prod(1) + b[:, 3:6].prod(1)) / (1 + iou)
    corners = np.concatenate([oracles.corners(a), oracles.corners(b)], axis=1)
    aligned = np.einsum("nij,nci->ncj", oracles.turns(b[:, 6]), corners)  # along the axes of the target
    extents = np.ptp(aligned, axis=1)
    volume = extents.prod(1)
    distance = ((a[:, :3] - b[:, :3]) ** 2).sum(1)
    expected = {
        "iou": 1 - iou,
        "log_iou": -np.log(np.maximum(iou, 1e-6)),
        "giou": 1 - iou + (volume - unions) / volume,
        "diou": 1 - iou + distance / (extents**2).sum(1),
    }[kind]
    prediction, target = oriented(f32(a)), oriented(f32(b))
    (total, count), gradient = iou_gradient(prediction, target, jnp.asarray(mask), kind)
    np.testing.assert_allclose(total, expected[mask].sum(), rtol=2e-6)
    assert int(count) == mask.sum()
    assert np.isfinite(gradient).all()
    assert not np.asarray(gradient)[~mask].any()


def test_masked_values_get_zero_gradient():
    masked = f32([[np.inf] * 8, [np.nan] * 8] * (NUMBER // 2))
    box = oriented(f32([[0, 0, 0, 4, 2, 1, 0.3]] * NUMBER))
    for kind in KINDS:
        assert not np.asarray(iou_gradient(masked, box, jnp.zeros(NUMBER, bool), kind)[1]).any()


@pytest.mark.parametrize(("kind", "loss"), [("iou", 1), ("log_iou", -math.log(1e-6)), ("giou", 1), ("diou", 1)])
def test_boxes_without_size_have_finite_losses_and_gradients(kind, loss):
    box = oriented(jnp.zeros((NUMBER, 7)))
    (total, _), gradient = iou_gradient(box, box, jnp.ones(NUMBER, bool), kind)
    assert float(total) == pytest.approx(NUMBER * loss, rel=1e-5)
    assert np.isfinite(gradient).all()


def test_centreness_is_a_gaussian_of_the_3d_distance(rng):
    prediction, target = rng.normal(0, 0.5, (2, NUMBER, 8))
    actual = jax.jit(centreness, static_argnums=2)(f32(prediction), f32(target), 0.75)
    expected = [
        math.exp(-(math.dist(a[:3], b[:3]) ** 2) / 0.75**2) for a, b in zip(prediction, target, strict=True)
    ]
    np.testing.assert_allclose(actual, expected, rtol=2e-6)
    each = jax.vmap(lambda a, b: centreness(a[None], b[None], 0.75)[0])(f32(prediction), f32(target))
    np.testing.assert_allclose(each, actual, rtol=1e-6)
    far = jax.grad(lambda a: centreness(a, f32(target), 0.75).sum())(f32(prediction) + 1e20)
    same = jax.grad(lambda a: centreness(a, a, 0.75).sum())(f32(prediction))
    assert np.isfinite(far).all()
    assert not np.asarray(same).any()


def test_iou_prediction_loss_is_binary_cross_entropy_without_gradient_for_the_iou(rng):
    logits, iou, mask = rng.normal(0, 3, NUMBER), rng.random(NUMBER), rng.random(NUMBER) < 0.6
    total, _ = iou_prediction_loss(f32(logits), f32(iou), jnp.asarray(mask))
    p = 1 / (1 + np.exp(-logits))
    expected = -(iou * np.log(p) + (1 - iou) * np.log(1 - p))
    np.testing.assert_allclose(total, expected[mask].sum(), rtol=1e-5)
    gradient = jax.grad(lambda i: iou_prediction_loss(f32(logits), i, jnp.asarray(mask))[0])(f32(iou))
    assert not np.asarray(gradient).any()
    huge = iou_prediction_loss(f32([1e4, -1e4]), f32([1, 0]), jnp.ones(2, bool))[0]
    assert float(huge) == 0
    masked = f32([np.nan, np.inf])
    gradient = jax.grad(lambda x: iou_prediction_loss(x, f32([1, 0]), jnp.zeros(2, bool))[0])(masked)
    assert not np.asarray(gradient).any()


def test_losses_are_weighed_by_name():
    config = LossConfig(
        classification_weight=1, l1_weight=0.25, iou_weight=2, iou_prediction_weight=0.5, velocity_weight=0.2
    )
    losses = {"mine": f32(1.0), "classification": f32(8.0), "l1": f32(4.0), "iou": f32(2.0)}
    assert float(weighted(losses | {"iou_prediction": f32(6.0)}, config)) == 1 + 8 + 1 + 4 + 3
    assert float(weighted({"top_q": f32(3.0)}, config)) == 3
