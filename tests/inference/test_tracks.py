"""Tracks of objects with known motion."""

import numpy as np
import pytest

from fcos_lidar_jax.data.box_geometry import transform_boxes
from fcos_lidar_jax.inference.tracks import Tracks, track


def objects(seed, number=60):
    """Boxes of three classes, initially at least 3 m apart; some move at up to 15 m/s per axis."""
    rng = np.random.default_rng(seed)
    boxes = np.zeros((number, 9))
    boxes[:, :2] = np.stack(np.meshgrid(np.arange(10.0), np.arange(6.0)), -1).reshape(-1, 2)[:number] * 3
    boxes[:, 3:6] = 4, 2, 1.5
    boxes[:, 7:9] = rng.uniform(-15, 15, (number, 2)) * (rng.random(number) < 0.5)[:, None]
    return boxes, rng.integers(0, 3, number), rng.random(number)


def moved(boxes, dt):
    after = boxes.copy()
    after[:, :2] += dt * boxes[:, 7:9]
    return after


@pytest.mark.parametrize("seed", range(5))
def test_without_noise_every_object_keeps_its_track(seed):
    boxes, labels, scores = objects(seed)
    rng, tracks, expected = np.random.default_rng(seed), Tracks(), None
    for _ in range(12):
        order = rng.permutation(len(boxes))
        tracks, ids = track(tracks, boxes[order], labels[order], scores[order], 0.5)
        by_object = ids[np.argsort(order)]
        expected = by_object if expected is None else expected
        np.testing.assert_array_equal(by_object, expected)
        boxes, scores = moved(boxes, 0.5), rng.random(len(boxes))
    assert sorted(expected) == list(range(60))


def test_the_order_of_noisy_boxes_does_not_matter():
    """Not even for two boxes with the same place, class and score."""
    boxes, labels, scores = objects(3)
    rng = np.random.default_rng(0)
    boxes[1], labels[1], scores[:2] = boxes[0], labels[0], 0.5
    one, other = Tracks(), Tracks()
    for _ in range(6):
        noisy = boxes + rng.normal(0, 1, boxes.shape)
        noisy[1] = noisy[0]
        order = rng.permutation(len(boxes))
        one, ids = track(one, noisy, labels, scores, 0.1)
        other, shuffled = track(other, noisy[order], labels[order], scores[order], 0.1)
        back = shuffled[np.argsort(order)]
        np.testing.assert_array_equal(np.sort(ids[:2]), np.sort(back[:2]))
        np.testing.assert_array_equal(ids[2:], back[2:])
        assert len(set(ids.tolist())) == len(ids)


@pytest.mark.parametrize(("hidden", "track_id"), [(3, 0), (4, 1)])
def test_a_track_survives_a_short_occlusion(hidden, track_id):
    box, label, score = np.array([[0.0, 0, 0, 4, 2, 1, 0, 10, 0]]), np.zeros(1, int), np.ones(1)
    tracks, _ = track(Tracks(), box, label, score, 0)
    for _ in range(hidden):
        tracks, ids = track(tracks, np.zeros((0, 9)), np.zeros(0, int), np.zeros(0), 0.5)
        assert ids.shape == (0,)
    _, ids = track(tracks, moved(box, 0.5 * (hidden + 1)), label, score, 0.5)
    assert ids.tolist() == [track_id]


@pytest.mark.parametrize(
    ("dt", "shift", "label", "track_id"),
    [(2.04, 0, 0, 0), (2.1, 0, 0, 1), (100, 0, 0, 1), (0.5, 1.9, 0, 0), (0.5, 2.1, 0, 1), (0.5, 0, 1, 1)],
)
def test_a_track_continues_with_near_boxes_of_its_class_after_a_short_time(dt, shift, label, track_id):
    box = np.array([[0.0, 0, 0, 4, 2, 1, 0, np.nan, np.nan]])
    tracks, _ = track(Tracks(), box, np.zeros(1, int), np.ones(1), 0)
    box[0, 0] += shift
    assert track(tracks, box, np.full(1, label), np.ones(1), dt)[1].tolist() == [track_id]


def test_positions_headings_and_velocities_are_transformed_to_the_world():
    rng, angle = np.random.default_rng(0), 0.7
    boxes = rng.normal(0, 10, (20, 9))
    pose = np.eye(4)
    pose[:2, :2], pose[:3, 3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], (5, -3, 1)
    world = transform_boxes(boxes, pose)
    for before, after in zip(boxes, world, strict=True):
        for reach in (0.0, 1.0):  # the centre, and a point ahead of it
            point = before[:3] + reach * np.array([np.cos(before[6]), np.sin(before[6]), 0])
            there = after[:3] + reach * np.array([np.cos(after[6]), np.sin(after[6]), 0])
            np.testing.assert_allclose((pose @ [*point, 1])[:3], there, atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3] @ [*before[7:9], 0], [*after[7:9], 0], atol=1e-12)
