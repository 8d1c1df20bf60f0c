"""Check simulated frames: reproducible bytes, exact counts, one cell per ray, all classes, fused sweeps."""

import numpy as np
import oracles
import pytest

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.projection import image_cells
from fcos_lidar_jax.sensors import ARGOVERSE2, NUSCENES_HDL32E, SHORT_RANGE, TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.simulation.frames import make_frame

LAGS = (np.arange(10) * 0.05).astype(np.float32)
NEAR = {"num_objects": 14, "reach_m": 10.0}
FUSED = NEAR | {"reading": CloudReading(10, "none"), "fast_traffic": True}


def assert_equal(a, b):
    for name in vars(a):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("sensor", [TINY, NUSCENES_HDL32E, ARGOVERSE2], ids=lambda s: s.name)
def test_frames_are_reproducible_with_exact_counts_and_one_cell_per_ray(sensor):
    frame = make_frame(11, sensor)
    make_frame(12, sensor)
    assert_equal(frame, make_frame(11, sensor))
    assert frame.points.shape[1] == sensor.point_columns
    assert (frame.num_points >= 1).all()
    box = int(frame.num_points.argmax())
    inside = sum(oracles.inside(p[:3].astype(float), frame.boxes[box].astype(float)) for p in frame.points)
    assert inside == frame.num_points[box] > 20
    cells = np.asarray(image_cells(frame.points, np.ones(len(frame.points), bool), sensor)[0])
    seen = cells[cells < sensor.num_rows * sensor.num_columns]
    # A scan spans slightly more than a turn, and lasers fire one after another: a few cells get two points.
    assert len(np.unique(seen)) > 0.95 * len(seen)
    assert len(seen) > 0.3 * sensor.num_rows * sensor.num_columns


def test_frames_are_level_with_separate_objects_of_all_classes():
    labels, moving = [], 0
    for seed in range(40):
        frame = make_frame(seed, TINY)
        labels += frame.labels.tolist()
        boxes = frame.boxes.astype(np.float64)
        one, other = np.triu_indices(len(boxes), 1)
        assert not oracles.iou(boxes[one], boxes[other], vertical=False).any()
        speed = np.hypot(boxes[:, 7], boxes[:, 8])
        along = boxes[:, 7] * np.cos(boxes[:, 6]) + boxes[:, 8] * np.sin(boxes[:, 6])
        np.testing.assert_allclose(along, speed, atol=1e-5)
        moving += (speed > 0.5).sum()
        bottom = boxes[:, 2] - boxes[:, 5] / 2
        ground = np.median(frame.points[frame.points[:, 2] < -1.5, 2])
        assert ((bottom > ground - 0.15) & (bottom < ground + 0.2)).all()  # on the road or the pavement
    counts = np.bincount(labels, minlength=10)
    assert 15 <= counts.min() <= counts.max() < 4 * counts.min(), counts
    assert 0.1 < moving / len(labels) < 0.6


def test_simulated_frames_annotate_near_objects_with_enough_points():
    near, complete = (SimulatedFrames(TINY, 6, 7, reach_m=8.0, min_points=least) for least in (5, 1))
    assert [near.name(index) for index in (0, 2)] == ["seed 7", "seed 9"]
    hidden = 0
    for i in range(6):
        frame, whole = near.frame(i), complete.frame(i)
        np.testing.assert_array_equal(frame.points, whole.points)
        np.testing.assert_array_equal(frame.boxes, whole.boxes[whole.num_points >= 5])
        np.testing.assert_array_equal(near.labels(i), frame.labels)
        hidden += len(whole.boxes) - len(frame.boxes)
        assert not (np.abs(frame.points[:, :2]) < 1).all(axis=1).any()  # the ego vehicle
    assert hidden > 0
    sets = complete, SimulatedFrames(TINY, 6, 7, reach_m=20.0, min_points=1)
    boxes = (np.concatenate([frames.frame(i).boxes for i in range(6)]) for frames in sets)
    distance, far = (np.median(np.hypot(*b[:, :2].T)) for b in boxes)
    assert distance < 0.8 * far


@pytest.fixture(scope="module")
def fast_frames() -> list[Frame]:
    return [make_frame(seed, SHORT_RANGE, **FUSED) for seed in range(8)]


def test_fused_frames_are_reproducible_and_annotated_by_the_current_sweep(fast_frames):
    assert_equal(fast_frames[3], make_frame(3, SHORT_RANGE, **FUSED))
    for frame in fast_frames:
        lags = frame.points[:, 4]
        assert (np.diff(lags) >= 0).all()  # the current sweep first, then by age
        np.testing.assert_array_equal(np.unique(lags), LAGS)
        now = frame.points[lags == 0]
        assert (frame.num_points >= 1).all()
        np.testing.assert_array_equal(frame.num_points, count_inside(now, frame.boxes))
        assert (np.bincount(np.searchsorted(LAGS, lags)) > 0.8 * len(now)).all()
    assert any((count_inside(f.points, f.boxes) > 5 * f.num_points).any() for f in fast_frames)
    laser = make_frame(0, ARGOVERSE2, reading=CloudReading(2, "none"))
    assert laser.points.shape[1] == 6
    assert set(np.unique(laser.points[:, 5])) <= set(range(64))
