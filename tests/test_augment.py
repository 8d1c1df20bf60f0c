"""Compare augmentation with explicit matrices on points, corners and velocities."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from fcos_lidar_jax.augment import augment, check_augmentation, flip_x, flip_y, rotate, sample_key, scale
from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, sector

ANGLE = 0.7
TURN = np.array([[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1]])
CASES = {
    "flip_x": (flip_x, np.diag([-1.0, 1, 1])),
    "flip_y": (flip_y, np.diag([1.0, -1, 1])),
    "rotate": (lambda p, b: rotate(p, b, jnp.float32(ANGLE)), TURN),
    "scale": (lambda p, b: scale(p, b, jnp.float32(1.03)), np.eye(3) * 1.03),
}


def sample():
    rng = np.random.default_rng(0)
    boxes = np.zeros((6, 9), np.float32)
    boxes[:, :7] = oracles.random_boxes(rng, 6, 15)
    boxes[:, 7:] = rng.normal(0, 5, (6, 2))
    points = rng.normal(0, 15, (300, 5)).astype(np.float32)
    points[:60, :3] = np.repeat(boxes[:, :3], 10, 0) + rng.normal(0, 0.3, (60, 3))
    return points, boxes


@pytest.mark.parametrize("name", CASES)
def test_points_corners_headings_and_velocities_follow_one_matrix(name):
    function, matrix = CASES[name]
    points, boxes = sample()
    new_points, new_boxes = (np.asarray(v) for v in function(jnp.asarray(points), jnp.asarray(boxes)))
    np.testing.assert_allclose(new_points[:, :3], points[:, :3] @ matrix.T, atol=1e-4)
    np.testing.assert_array_equal(new_points[:, 3:], points[:, 3:])
    for actual, expected in zip(oracles.corners(new_boxes), oracles.corners(boxes) @ matrix.T, strict=True):
        # Compare as sets, because a flip changes the order of the corners.
        distance = np.linalg.norm(actual[:, None] - expected[None], axis=-1)
        assert distance.min(1).max() < 1e-4
    heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(6)], 1) @ matrix.T
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    np.testing.assert_allclose(np.exp(1j * new_boxes[:, 6]), np.exp(1j * yaw), atol=1e-5)
    velocity = np.concatenate([boxes[:, 7:], np.zeros((6, 1))], 1) @ matrix.T
    np.testing.assert_allclose(new_boxes[:, 7:], velocity[:, :2], atol=1e-5)
    inside = [[oracles.inside(p, b) for b in boxes] for p in points[:60, :3]]
    still = [[oracles.inside(p, b) for b in new_boxes] for p in new_points[:60, :3]]
    assert np.mean(np.array(inside) == np.array(still)) > 0.995
    assert np.sum(inside) > 20


def test_random_values_cover_their_ranges_and_the_sensor_stays_fixed():
    origin = (1.43, 0.5, 2.184)
    points, boxes = sample()
    points[2:8, :3] = boxes[:, :3]
    points[0, :3] = origin
    points[1, :3] = (origin[0] + 10, origin[1], origin[2])
    go = jax.jit(
        jax.vmap(lambda k: augment(k, jnp.asarray(points), jnp.asarray(boxes), AugmentConfig(), origin_m=origin))
    )
    moved, moved_boxes = map(np.asarray, go(jax.random.split(jax.random.key(0), 400)))
    np.testing.assert_allclose(moved_boxes[:, :, :3], moved[:, 2:8, :3], atol=3e-5)
    np.testing.assert_allclose(moved[:, 0, :3], np.tile(origin, (400, 1)), atol=1e-5)
    arm = moved[:, 1, :2] - moved[:, 0, :2]
    length, angle = np.linalg.norm(arm, axis=1) / 10, np.arctan2(arm[:, 1], arm[:, 0])
    assert length.min() > 0.95 - 1e-4
    assert length.max() < 1.05 + 1e-4
    assert np.ptp(length) > 0.08
    assert angle.min() < -3
    assert angle.max() > 3
    # A mirror image has the opposite handedness.
    third = moved[:, 60, :2] - moved[:, 0, :2]
    reference = np.cross([10, 0, 0], [*(points[60, :2] - np.array(origin[:2])), 0])[2]
    hand = arm[:, 0] * third[:, 1] - arm[:, 1] * third[:, 0]
    assert 0.35 < np.mean(np.sign(hand) != np.sign(reference)) < 0.65


@pytest.mark.parametrize("axis", [0, 1])
def test_a_flip_mirrors_its_axis(axis):
    points, boxes = sample()
    config = AugmentConfig(1.0 - axis, float(axis), 0.0, (1.0, 1.0))
    moved, _ = augment(jax.random.key(0), jnp.asarray(points), jnp.asarray(boxes), config)
    expected = points * np.where(np.arange(5) == axis, -1, 1)
    np.testing.assert_allclose(moved, expected, atol=1e-5)


def test_augmentation_that_leaves_a_sensors_sector_is_rejected():
    ahead, right = (sector(NUSCENES_HDL32E, middle, 272) for middle in (np.pi / 2, 0.0))
    behind = sector(NUSCENES_HDL32E, -np.pi, 272)  # crosses azimuth pi
    fine = {"max_rotation_rad": 0.5, "flip_x_probability": 0.0, "flip_y_probability": 0.0}
    check_augmentation(AugmentConfig(), NUSCENES_HDL32E)
    whole = dataclasses.replace(NUSCENES_HDL32E, azimuth_limits_rad=(-np.pi, np.pi))
    check_augmentation(AugmentConfig(), whole)
    for sensor, allowed, refused in (
        (ahead, "flip_x_probability", "flip_y_probability"),
        (right, "flip_y_probability", "flip_x_probability"),
        (behind, "flip_y_probability", "flip_x_probability"),
    ):
        check_augmentation(AugmentConfig(**{**fine, allowed: 0.5}), sensor)
        with pytest.raises(ValueError, match=rf"augment\.{refused}: got 0.5, expected 0: .*90 degrees"):
            check_augmentation(AugmentConfig(**{**fine, refused: 0.5}), sensor)
        with pytest.raises(ValueError, match=r"augment\.max_rotation_rad: got 0.9, expected at most 0.787"):
            check_augmentation(AugmentConfig(**{**fine, "max_rotation_rad": 0.9}), sensor)


def test_unknown_velocities_stay_unknown():
    points, boxes = sample()
    boxes[2, 7:] = np.nan
    config = AugmentConfig(flip_x_probability=0, flip_y_probability=1)  # integers fit floats
    _, moved = augment(jax.random.key(1), jnp.asarray(points), jnp.asarray(boxes), config)
    unknown = np.isnan(np.asarray(moved))
    assert unknown[2, 7:].all()
    assert unknown.sum() == 2


def test_sample_keys_depend_on_step_and_index_only():
    keys = [sample_key(jax.random.key(0), jnp.int32(s), jnp.int32(i)) for s in range(3) for i in range(3)]
    assert len({tuple(np.asarray(jax.random.key_data(k)).tolist()) for k in keys}) == 9
    batched = jax.vmap(lambda i: sample_key(jax.random.key(0), jnp.int32(2), i))(jnp.arange(3, dtype=jnp.int32))
    for i in range(3):
        np.testing.assert_array_equal(jax.random.key_data(batched[i]), jax.random.key_data(keys[6 + i]))
