"""Compare angles, norms and boxes with NumPy in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from scipy.spatial.transform import Rotation

from fcos_lidar_jax import assignment, iou, nms
from fcos_lidar_jax.geometry import (
    atan2,
    image_columns,
    points_in_box,
    pose_matrix,
    rotation_matrix,
    safe_norm,
    spherical,
    wrap_angle,
)
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, sector
from fcos_lidar_jax.types import check_columns


def awkward_pairs():
    special = [0.0, -0.0, 1.0, -1.0, 1e-30, -1e-30, 1e30, -1e30, 54.0, 1e-3]
    grid = np.array([(y, x) for y in special for x in special], np.float32)
    rng = np.random.default_rng(0)
    return np.concatenate([grid, rng.normal(0, 20, (20_000, 2)).astype(np.float32)])


def test_atan2_matches_numpy_for_regular_and_special_values():
    pairs = awkward_pairs()
    expected = np.arctan2(pairs[:, 0].astype(np.float64), pairs[:, 1].astype(np.float64))
    for function in (atan2, jax.jit(atan2), jax.vmap(atan2)):
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


def test_columns_of_a_sector_match_the_full_turn():
    azimuth = np.linspace(-np.pi, np.pi, 20001)[:-1].astype(np.float32)
    whole, everywhere = image_columns(jnp.asarray(azimuth), NUSCENES_HDL32E)
    assert everywhere.all()
    exact = np.floor((np.pi - azimuth.astype(np.float64)) / (2 * np.pi) * 1086).astype(int) % 1086
    assert (np.asarray(whole) == exact).mean() > 0.999
    # Columns 100 to 371 of the turn.
    ahead = sector(NUSCENES_HDL32E, np.pi - (100 + 272 / 2) * NUSCENES_HDL32E.column_rad, 272)
    column, inside = jax.jit(image_columns, static_argnums=1)(jnp.asarray(azimuth), ahead)
    expected = (exact >= 100) & (exact < 372)
    assert (np.asarray(inside) == expected).mean() > 0.999
    both = np.asarray(inside) & expected
    assert (np.asarray(column)[both] == exact[both] - 100).mean() > 0.99


def test_spherical_inverts_to_the_point():
    points = np.random.default_rng(1).normal(0, 20, (500, 3)).astype(np.float32)
    r, theta, phi = (np.asarray(v, np.float64) for v in spherical(jnp.asarray(points)))
    back = np.stack([r * np.cos(phi) * np.cos(theta), r * np.cos(phi) * np.sin(theta), r * np.sin(phi)], 1)
    np.testing.assert_allclose(back, points, atol=5e-5)


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
    assert wrapped.min() >= kind(-np.pi) - np.spacing(kind(30))
    if dtype is jnp.float32:  # sums of two angles wrap to exactly -pi
        assert wrapped[np.abs(angles) < 6.5].min() == kind(-np.pi)
    few = np.flatnonzero(np.abs(exact) < 19)
    on_device = wrap_angle(jnp.asarray(exact[few].astype(np.float32)))
    np.testing.assert_allclose(wrapped[few], on_device, atol=4e-6)


def test_the_boundary_of_a_box_is_inside():
    box = jnp.array([1, 2, 3, 4, 2, 1, 0], jnp.float32)
    for axis, half in enumerate((2.0, 1.0, 0.5)):
        for sign in (-1, 1):
            point = np.array([1, 2, 3], np.float32)
            point[axis] += sign * half
            assert bool(points_in_box(jnp.asarray(point), box))
            point[axis] += sign * np.float32(1e-5)
            assert not bool(points_in_box(jnp.asarray(point), box))


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


FLAT = np.array([[0, 0, 4, 2, 0]], np.float32)  # x, y, l, w, yaw
BOX = np.array([[0, 0, 0, 4, 2, 1, 0]], np.float32)
ONE = np.ones(1, np.float32)
NMS = {"iou_threshold": 0.2, "max_outputs": 1}


@pytest.mark.parametrize(
    "call",
    [
        lambda: points_in_box(np.zeros((1, 3), np.float32), FLAT),
        lambda: iou.rotated_iou_bev(FLAT, FLAT),
        lambda: iou.rotated_iou_3d(BOX, FLAT),
        lambda: nms.rotated_nms(FLAT, ONE, ONE > 0, **NMS),
        lambda: nms.merge_boxes(FLAT, ONE, ONE > 0, jnp.zeros(1, jnp.int32), jnp.array([True]), iou_threshold=0.2),
        lambda: assignment.owners(np.zeros((1, 3), np.float32), ONE > 0, FLAT, ONE > 0, form="loop"),
        lambda: assignment.owners(np.zeros((1, 3), np.float32), ONE > 0, FLAT, ONE > 0, form="reduction"),
    ],
)
def test_boxes_of_another_layout_are_refused(call):
    with pytest.raises(ValueError, match=r"boxes: got shape .*5,?\), expected columns x, y, z, l, w, h, yaw, "):
        call()


def test_columns_may_only_follow_where_the_layout_says_so():
    check_columns("box", np.zeros((2, 9)), "x, y, z, ...")
    with pytest.raises(ValueError, match=r"value: got shape \(2, 9\), expected columns x, y, z"):
        check_columns("value", np.zeros((2, 9)), "x, y, z")
    with pytest.raises(ValueError, match=r"box: got shape \(\)"):
        check_columns("box", np.zeros(()), "x, ...")
