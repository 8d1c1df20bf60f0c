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


def test_objects_stand_on_level_ground_and_move_ahead():
    for seed in range(10):
        frame = make_frame(seed, TINY)
        boxes = frame.boxes.astype(np.float64)
        along = boxes[:, 7] * np.cos(boxes[:, 6]) + boxes[:, 8] * np.sin(boxes[:, 6])
        np.testing.assert_allclose(along, np.hypot(boxes[:, 7], boxes[:, 8]), atol=1e-5)
        bottom = boxes[:, 2] - boxes[:, 5] / 2
        ground = np.median(frame.points[frame.points[:, 2] < -1.5, 2])
        assert ((bottom > ground - 0.15) & (bottom < ground + 0.2)).all()  # on the road or the pavement


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


def test_close_points_of_fused_sweeps_are_removed_in_the_frame_of_their_sweep(fast_frames):
    frames = SimulatedFrames(SHORT_RANGE, 3, 5, reading=CloudReading(10), fast_traffic=True)
    passed = 0
    for i in range(3):
        frame, whole = frames.frame(i), fast_frames[5 + i]
        np.testing.assert_array_equal(frame.boxes, whole.boxes[whole.num_points >= 5])
        dropped = [(whole.points[:, 4] == lag).sum() - (frame.points[:, 4] == lag).sum() for lag in LAGS]
        assert 0 < 0.9 * max(dropped) < min(dropped)  # each sweep sees the same ego vehicle
        close, old = (np.abs(frame.points[:, :2]) < 1).all(axis=1), frame.points[:, 4] > 0
        assert not (close & ~old).any()
        passed += (close & old).sum()  # points ahead of the ego vehicle that it has since reached
    assert passed > 20
