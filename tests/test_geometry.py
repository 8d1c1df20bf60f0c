"""Compare angles, norms and boxes with NumPy in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.geometry import atan2, points_in_box, pose_matrix, rotation_matrix, safe_norm, wrap_angle


def awkward_pairs():
    special = [0.0, -0.0, 1.0, -1.0, 1e-30, -1e-30, 1e30, -1e30, 54.0, 1e-3]
    grid = np.array([(y, x) for y in special for x in special], np.float32)
    rng = np.random.default_rng(0)
    return np.concatenate([grid, rng.normal(0, 20, (20_000, 2)).astype(np.float32)])


def test_atan2_matches_numpy_for_regular_and_special_values():
    pairs = awkward_pairs()
    expected = np.arctan2(pairs[:, 0].astype(np.float64), pairs[:, 1].astype(np.float64))
    for function in (jax.jit(atan2), jax.jit(jax.vmap(atan2))):
        actual = np.asarray(function(jnp.asarray(pairs[:, 0]), jnp.asarray(pairs[:, 1])))
        assert np.abs(actual - expected).max() < 3e-7


def test_gradients_of_angles_and_norms_are_exact_and_finite_at_zero():
    y, x = 3.0, -4.0
    gradient = jax.grad(atan2, argnums=(0, 1))(jnp.float32(y), jnp.float32(x))
    np.testing.assert_allclose(gradient, [x / 25, -y / 25], atol=1e-6)
    np.testing.assert_allclose(jax.grad(safe_norm)(jnp.float32(3), jnp.float32(4)), 0.6, rtol=1e-6)
    for function in (atan2, safe_norm):
        at_zero = jax.grad(function, argnums=(0, 1))(jnp.float32(0), jnp.float32(0))
        assert np.isfinite(np.asarray(at_zero)).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64, jnp.float32])
def test_wrapped_angles_lie_in_the_half_open_interval_and_keep_their_direction(dtype):
    exact = np.concatenate([np.arange(-9, 10) * np.pi, np.random.default_rng(3).uniform(-20, 20, 5000)])
    angles = exact.astype(dtype)
    angles = np.concatenate([angles, *(np.nextafter(angles, angles.dtype.type(end)) for end in (-99, 99))])
    wrapped = wrap_angle(jnp.asarray(angles) if dtype is jnp.float32 else angles)
    assert isinstance(wrapped, jax.Array if dtype is jnp.float32 else np.ndarray)
    wrapped, kind = np.asarray(wrapped), angles.dtype.type
    assert wrapped.dtype == angles.dtype
    difference = np.angle(np.exp(1j * (wrapped.astype(np.float64) - angles.astype(np.float64))))
    assert np.abs(difference).max() < (1e-13 if kind is np.float64 else 1e-5)
    assert wrapped.max() < kind(np.pi)
    assert wrapped.min() >= kind(-np.pi)
    if dtype is jnp.float32:  # sums of two angles wrap to exactly -pi
        assert wrapped[np.abs(angles) < 6.5].min() == kind(-np.pi)
    few = np.flatnonzero(np.abs(exact) < 19)
    on_device = wrap_angle(jnp.asarray(exact[few].astype(np.float32)))
    np.testing.assert_allclose(wrapped[few], on_device, atol=4e-6)


def test_the_boundary_of_a_box_is_inside():
    box = jnp.array([1, 2, 3, 4, 2, 1, 0], jnp.float32)
    centre, half = np.float32([1, 2, 3]), np.float32([2, 1, 0.5])
    ends = np.concatenate([np.diag(half), -np.diag(half)])
    assert points_in_box(jnp.asarray(centre + ends), box).all()
    assert not points_in_box(jnp.asarray(centre + ends + 1e-5 * np.sign(ends)), box).any()


def test_points_in_box_matches_explicit_rotation():
    rng = np.random.default_rng(2)
    boxes = oracles.random_boxes(rng, 20).astype(np.float32)
    points = rng.normal(0, 2, (200, 3)).astype(np.float32)
    actual = np.asarray(points_in_box(jnp.asarray(points)[:, None], jnp.asarray(boxes)[None]))
    expected = [[oracles.inside(p, b) for b in boxes] for p in points]
    np.testing.assert_array_equal(actual, expected)
    assert actual.any()


def test_rotations_and_poses_match_scipy():
    rng = np.random.default_rng(3)
    rotation, translation = rng.normal(size=(50, 4)), rng.normal(size=(50, 3))
    expected = Rotation.from_quat(rotation, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_matrix(rotation), expected, atol=1e-15)
    poses = pose_matrix(rotation, translation)
    np.testing.assert_array_equal(poses[7], pose_matrix(rotation[7], translation[7]))
    points = rng.normal(size=(50, 4))
    points[:, 3] = 1
    moved = Rotation.from_quat(rotation, scalar_first=True).apply(points[:, :3]) + translation
    np.testing.assert_allclose((poses @ points[:, :, None])[:, :3, 0], moved, atol=1e-14)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0, 0, 0, 1.0], (50, 1)))
