"""Check equation 2: encoding against NumPy, decoding as its inverse, finite gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.coding import decode, decode_oriented, encode

jitted = functools.cache(functools.partial(jax.jit, static_argnames="axes"))
both_axes = pytest.mark.parametrize("axes", ["lidar", "ray"])


def samples(number=200):
    rng = np.random.default_rng(0)
    boxes = np.zeros((number, 9), np.float32)
    boxes[:, :3] = rng.normal(0, 20, (number, 3))
    boxes[:, 3:6] = rng.uniform(0.2, 12, (number, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, number)
    boxes[:, 7:] = rng.normal(0, 5, (number, 2))
    points = boxes[:, :3] + rng.normal(0, 1, (number, 3)).astype(np.float32)
    return boxes, points, np.arctan2(points[:, 1], points[:, 0]).astype(np.float32)


def test_encoding_matches_equation_2():
    boxes, points, azimuth = samples()
    yaw = (boxes[:, 6].astype(float) - azimuth)[:, None]
    expected = [boxes[:, :3] - points, np.log(boxes[:, 3:6]), np.sin(yaw), np.cos(yaw), boxes[:, 7:]]
    np.testing.assert_allclose(jitted(encode)(boxes, points, azimuth), np.concatenate(expected, 1), atol=1e-6)
    boxes[:, 3] = 0
    assert (np.asarray(jitted(encode)(boxes, points, azimuth))[:, 3] == -5).all()


def test_ray_axes_rotate_offset_and_velocity():
    boxes, points, azimuth = samples()
    actual = np.asarray(jitted(encode)(boxes, points, azimuth, axes="ray"))
    for numbers, box, point, angle in zip(actual, boxes, points, azimuth.astype(float), strict=True):
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(numbers[:2], axes @ (box[:2] - point[:2]), atol=1e-6)
        np.testing.assert_allclose(numbers[8:], axes @ box[7:], atol=4e-6)
    unchanged = np.asarray(jitted(encode)(boxes, points, azimuth))[:, 2:8]
    np.testing.assert_array_equal(actual[:, 2:8], unchanged)


@both_axes
def test_decoding_inverts_encoding(axes):
    boxes, points, azimuth = map(jnp.asarray, samples())
    numbers = jitted(encode)(boxes, points, azimuth, axes=axes)
    back = np.asarray(jitted(decode)(numbers, points, azimuth, axes=axes))
    np.testing.assert_allclose(back, boxes, atol=5e-5, rtol=1e-5)
    assert (back[:, 6] >= -np.pi).all()
    assert (back[:, 6] < np.pi).all()
    scaled = numbers * jnp.array([1] * 6 + [3, 3, 1, 1])
    oriented = np.asarray(jitted(decode_oriented)(scaled, points, azimuth, axes=axes))
    np.testing.assert_allclose(oriented[:, :6], boxes[:, :6], atol=5e-5, rtol=1e-5)
    np.testing.assert_allclose(oriented[:, 6], np.cos(boxes[:, 6]), atol=1e-5)
    np.testing.assert_allclose(oriented[:, 7], np.sin(boxes[:, 6]), atol=1e-5)


@both_axes
def test_only_unknown_velocities_encode_to_nan(axes):
    boxes, points, azimuth = samples()
    boxes[:3, 7:] = np.nan
    unknown = np.isnan(jitted(encode)(boxes, points, azimuth, axes=axes))
    assert unknown[:3, 8:].all()
    assert unknown.sum() == 6
    boxes[3, 3:6] = 0  # of no size
    total = jax.grad(lambda *args: jnp.nansum(encode(*args, axes=axes)), argnums=(0, 1, 2))
    gradients = jax.jit(total)(*map(jnp.asarray, (boxes, points, azimuth)))
    assert all(np.isfinite(leaf).all() for leaf in gradients)


@both_axes
def test_degenerate_predictions_decode_to_finite_boxes_with_finite_gradients(axes):
    def of(numbers):
        return decode_oriented(numbers, jnp.zeros(3), jnp.float32(0.3), axes=axes).sum()

    total = jax.jit(jax.value_and_grad(of))
    for heading in (0.0, 1e-30, 1e30):
        value, gradient = total(jnp.array([0, 0, 0, 1e4, -1e4, 0, heading, heading, 0, 0], jnp.float32))
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()
    size = jitted(decode)(
        jnp.array([0, 0, 0, 1e4, -1e4, 0, 0, 1, 0, 0], jnp.float32), jnp.zeros(3), jnp.float32(0)
    )[3:5]
    np.testing.assert_allclose(size, [np.exp(5), np.exp(-5)], rtol=1e-5)
