"""Equation 2: encoding by hand, decoding inverts it, gradients stay finite."""

import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.coding import decode, decode_oriented, encode


def samples(number=200):
    rng = np.random.default_rng(0)
    boxes = np.zeros((number, 9), np.float32)
    boxes[:, :3] = rng.normal(0, 20, (number, 3))
    boxes[:, 3:6] = rng.uniform(0.2, 12, (number, 3))
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, number)
    boxes[:, 7:] = rng.normal(0, 5, (number, 2))
    points = boxes[:, :3] + rng.normal(0, 1, (number, 3)).astype(np.float32)
    return boxes, points, np.arctan2(points[:, 1], points[:, 0]).astype(np.float32)


def test_encoding_is_equation_2():
    boxes, points, azimuth = samples()
    found = np.asarray(encode(*map(jnp.asarray, (boxes, points, azimuth))))
    for b, p, a, numbers in zip(boxes.astype(float), points, azimuth, found, strict=True):
        yaw = b[6] - a
        expected = [*(b[:3] - p), *np.log(b[3:6]), np.sin(yaw), np.cos(yaw), *b[7:]]
        np.testing.assert_allclose(numbers, expected, atol=2e-5)


def test_decoding_inverts_encoding():
    boxes, points, azimuth = map(jnp.asarray, samples())
    numbers = encode(boxes, points, azimuth)
    back = np.asarray(decode(numbers, points, azimuth))
    np.testing.assert_allclose(back, boxes, atol=5e-5, rtol=1e-5)
    assert (back[:, 6] >= -np.pi).all()
    assert (back[:, 6] < np.pi).all()
    oriented = np.asarray(decode_oriented(numbers * jnp.array([1] * 6 + [3, 3, 1, 1]), points, azimuth))
    np.testing.assert_allclose(oriented[:, :6], boxes[:, :6], atol=5e-5, rtol=1e-5)
    np.testing.assert_allclose(oriented[:, 6], np.cos(boxes[:, 6]), atol=1e-5)
    np.testing.assert_allclose(oriented[:, 7], np.sin(boxes[:, 6]), atol=1e-5)


def test_unknown_velocity_stays_unknown_and_nothing_else_does():
    boxes, points, azimuth = samples(3)
    boxes[:, 7:] = np.nan
    numbers = np.asarray(encode(*map(jnp.asarray, (boxes, points, azimuth))))
    assert np.isnan(numbers[:, 8:]).all()
    assert np.isfinite(numbers[:, :8]).all()


def test_degenerate_predictions_decode_to_finite_boxes_with_finite_gradients():
    for heading in (0.0, 1e-30, 1e30):
        numbers = jnp.array([0, 0, 0, 1e4, -1e4, 0, heading, heading, 0, 0], jnp.float32)

        def total(n):
            return decode_oriented(n, jnp.zeros(3), jnp.float32(0.3)).sum()

        value, gradient = jax.value_and_grad(total)(numbers)
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()
    size = decode(jnp.array([0, 0, 0, 1e4, -1e4, 0, 0, 1, 0, 0], jnp.float32), jnp.zeros(3), jnp.float32(0))[3:5]
    np.testing.assert_allclose(size, [np.exp(5), np.exp(-5)], rtol=1e-5)


def test_same_under_jit_and_vmap():
    boxes, points, azimuth = map(jnp.asarray, samples(20))
    numbers = encode(boxes, points, azimuth)
    for function, args in ((encode, (boxes, points, azimuth)), (decode, (numbers, points, azimuth))):
        plain = function(*args)
        np.testing.assert_allclose(jax.jit(function)(*args), plain, atol=1e-5)
        np.testing.assert_allclose(jax.vmap(function)(*args), plain, atol=1e-5)
