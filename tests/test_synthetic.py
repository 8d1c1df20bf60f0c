"""Simulated frames: the same bytes for the same seed, exact counts, one cell a beam, all classes."""

import numpy as np
import pytest

import oracles
from fcos_lidar_jax.data.batching import make_batch
from fcos_lidar_jax.data.frame import count_inside
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.projection import image_cells
from fcos_lidar_jax.sensors import ARGOVERSE2, NUSCENES_HDL32E, TINY, WAYMO_TOP
from fcos_lidar_jax.types import CLASSES


@pytest.mark.parametrize("sensor", [TINY, NUSCENES_HDL32E, WAYMO_TOP, ARGOVERSE2], ids=lambda s: s.name)
def test_frames_repeat_count_and_fill_one_cell_a_beam(sensor):
    frame = make_frame(11, sensor)
    make_frame(12, sensor)
    again = make_frame(11, sensor)
    for a, b in zip(vars(frame).values(), vars(again).values(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert frame.points.shape[1] == sensor.point_columns
    assert (frame.num_points >= 1).all()
    box = int(frame.num_points.argmax())
    inside = sum(oracles.inside(p[:3].astype(float), frame.boxes[box].astype(float)) for p in frame.points)
    assert inside == frame.num_points[box] > 20
    cells = np.asarray(image_cells(frame.points, np.ones(len(frame.points), bool), sensor)[0])
    seen = cells[cells < sensor.num_rows * sensor.num_columns]
    # A turn is slightly more than a full one, and lasers fire one after the other: a few columns are met twice.
    assert len(np.unique(seen)) > 0.95 * len(seen)
    assert len(seen) > 0.3 * sensor.num_rows * sensor.num_columns


def test_count_inside_is_exact():
    rng = np.random.default_rng(0)
    boxes, points = oracles.random_boxes(rng, 8), rng.normal(0, 3, (300, 3))
    expected = [sum(oracles.inside(p, b) for p in points) for b in boxes]
    assert count_inside(points, boxes).tolist() == expected


def test_frames_are_level_and_show_all_classes_apart_from_each_other():
    labels, moving = [], 0
    for seed in range(40):
        frame = make_frame(seed, TINY)
        labels += frame.labels.tolist()
        boxes = frame.boxes.astype(np.float64)
        pairs = [(i, j) for i in range(len(boxes)) for j in range(i)]
        apart = [oracles.iou(boxes[i : i + 1], boxes[j : j + 1], vertical=False)[0] == 0 for i, j in pairs]
        assert all(apart)
        speed = np.hypot(boxes[:, 7], boxes[:, 8])
        along = boxes[:, 7] * np.cos(boxes[:, 6]) + boxes[:, 8] * np.sin(boxes[:, 6])
        np.testing.assert_allclose(along, speed, atol=1e-5)
        moving += (speed > 0.5).sum()
        bottom = boxes[:, 2] - boxes[:, 5] / 2
        ground = np.median(frame.points[frame.points[:, 2] < -1.5, 2])
        assert ((bottom > ground - 0.15) & (bottom < ground + 0.2)).all()  # on the road or on the pavement
    counts = np.bincount(labels, minlength=10)
    assert counts.min() >= 15, dict(zip(CLASSES, counts, strict=True))
    assert counts.max() < 4 * counts.min(), dict(zip(CLASSES, counts, strict=True))
    assert 0.1 < moving / len(labels) < 0.6


def test_batches_pad_and_refuse_to_drop():
    frames = [make_frame(i, TINY) for i in range(2)]
    batch = make_batch(frames, max_points=4096, max_boxes=16)
    for i, frame in enumerate(frames):
        assert batch.valid[i].sum() == len(frame.points)
        np.testing.assert_array_equal(batch.points[i][batch.valid[i]], frame.points)
        np.testing.assert_array_equal(batch.boxes[i][batch.box_valid[i]], frame.boxes)
        np.testing.assert_array_equal(batch.labels[i][batch.box_valid[i]], frame.labels)
    with pytest.raises(ValueError, match=r"sample 0: points: got \d+, expected at most 100"):
        make_batch(frames, max_points=100, max_boxes=16)
    with pytest.raises(ValueError, match=r"boxes: got \d+, expected at most 2"):
        make_batch(frames, max_points=4096, max_boxes=2)


def test_simulated_frames_are_near_and_annotated_where_enough_points_show():
    near, all_of_them = SimulatedFrames(TINY, 6, reach_m=8.0), SimulatedFrames(TINY, 6, reach_m=8.0, min_points=1)
    far = SimulatedFrames(TINY, 6, reach_m=20.0, min_points=1)
    hidden = 0
    for i in range(6):
        frame, whole = near.frame(i), all_of_them.frame(i)
        np.testing.assert_array_equal(frame.points, whole.points)
        np.testing.assert_array_equal(frame.boxes, whole.boxes[whole.num_points >= 5])
        np.testing.assert_array_equal(near.labels(i), frame.labels)
        hidden += len(whole.boxes) - len(frame.boxes)
        assert not (np.abs(frame.points[:, :2]) < 1).all(axis=1).any()  # the car itself
    assert hidden > 0

    def median_distance(frames):
        return np.median(np.concatenate([np.hypot(*frames.frame(i).boxes[:, :2].T) for i in range(6)]))

    assert median_distance(all_of_them) < 0.8 * median_distance(far)
