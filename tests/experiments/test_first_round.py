"""Candidates in the first round: a cloud made by hand, and a simulated frame by loops."""

import dataclasses
import json
import math
import sys

import numpy as np
import pytest

from experiments.script import run_measurement
from experiments.studies import first_round as study
from experiments.studies.first_round import Args, cells_of_objects, in_image, summarize
from experiments.studies.round_contents import READING, SENSOR
from fcos_lidar_jax.data.box_geometry import inside_box
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frame_set import city_frames
from fcos_lidar_jax.simulation.lidar import SWEEP_S

STILL, MOVING = (0, 20, 0, 2, 2, 2, 0, 0, 0), (20, 0, 0, 2, 2, 2, 0, 10, 0)
"""Boxes x, y, z, l, w, h, yaw, vx, vy. The sensor sees the second half a turn before the end of a sweep: at
19.75 m in the current sweep, at 18.75 m a tenth of a second before."""
NOW = [(0, 19.5, 0, 0), (19.6, 0, 0, 0)]
NEARER_BEFORE = [(0, 19.2, 0, 0.1), (17.9, 0, 0, 0.1)]  # In the boxes of their time; the second no longer.
BEHIND = [(17.9, 0, -0.6, 0.1)]  # As the second, in a cell below.


def cloud(*rows) -> np.ndarray:
    """Points f32[n, 5] of rows (x, y, z, time lag)."""
    x, y, z, lag = np.array(rows, np.float32).T
    return np.stack([x, y, z, np.full_like(x, 9), lag], axis=1)


def test_priority_keeps_the_candidate_of_a_moving_object_and_not_what_it_left_behind():
    points, boxes = cloud(*NOW, *NEARER_BEFORE, *BEHIND), np.array([STILL, MOVING], np.float32)
    kept = cells_of_objects(points, boxes)
    assert {name: v.tolist() for name, v in kept.items()} == {"candidates": [1, 1], "left behind": [0, 1]}
    lost = cells_of_objects(points, boxes, prioritize_current=False)
    assert {name: v.tolist() for name, v in lost.items()} == {"candidates": [1, 0], "left behind": [0, 2]}


def test_without_older_sweeps_no_cell_is_left_behind():
    points, boxes = cloud(*NOW, *NEARER_BEFORE, *BEHIND), np.array([STILL, MOVING], np.float32)
    kept = cells_of_objects(points, boxes, only_current=True)
    assert {name: v.tolist() for name, v in kept.items()} == {"candidates": [1, 1], "left behind": [0, 0]}


def test_a_point_in_two_boxes_is_a_candidate_of_the_smaller_box_as_in_training():
    inner = (0, 19.5, 0, 1, 1, 1, 0, 0, 0)
    boxes = np.array([inner, STILL, inner], np.float32)
    assert cells_of_objects(cloud(*NOW), boxes)["candidates"].tolist() == [1, 0, 0]


def test_only_objects_with_a_current_point_within_the_limits_count():
    far = (0, 60, 0, 2, 2, 2, 0, 0, 0)
    points = cloud(NOW[0], (0, 60, 0, 0), *NEARER_BEFORE)
    assert in_image(points, np.array([STILL, MOVING, far], np.float32)).tolist() == [True, False, False]


def test_no_points_and_no_objects_are_counted_as_nothing():
    empty, boxes = np.zeros((0, 5), np.float32), np.array([STILL], np.float32)
    assert cells_of_objects(empty, boxes)["candidates"].tolist() == [0]
    assert cells_of_objects(cloud(*NOW), boxes[:0])["left behind"].tolist() == []


@pytest.mark.parametrize("prioritize_current", [True, False])
def test_a_simulated_frame_is_counted_as_by_a_loop(prioritize_current):
    reading = dataclasses.replace(READING, num_sweeps=3)
    frame = dataclasses.replace(city_frames(SENSOR, 1, 7), reading=reading).frame(0)
    points, boxes = frame.points, frame.boxes.astype(float)
    found = cells_of_objects(points, frame.boxes, prioritize_current=prioritize_current)
    image = project_points(
        points, np.ones(len(points), bool), SENSOR, num_rounds=1, prioritize_current=prioritize_current
    )
    first = points[[i for i in np.asarray(image.point_index).ravel() if i >= 0]]
    now, owner = np.array([inside_box(first, box) for box in boxes]), np.full(len(first), -1)
    for number, box in enumerate(boxes):
        delay = SWEEP_S * (1 - (math.pi - math.atan2(box[1], box[0])) / (2 * math.pi))
        for k in range(3):
            then = box - [*(box[7:9] * (k * SWEEP_S + delay)), *[0] * 7]
            owner[inside_box(first, then) & (np.round(first[:, 4] / SWEEP_S) == k)] = number
    behind = [np.sum((owner == number) & ~now[number]) for number in range(len(boxes))]
    assert now.sum() > 100
    assert sum(behind) > 20
    np.testing.assert_array_equal(found["candidates"], now.sum(axis=1))
    np.testing.assert_array_equal(found["left behind"], behind)


def test_shares_are_of_all_objects_and_their_intervals_over_frames():
    one = (np.array([False, True]), {"candidates": np.array([4, 0]), "left behind": np.array([0, 3])})
    other = (np.array([True]), {"candidates": np.array([5]), "left behind": np.array([1])})
    record = summarize([one, other])
    assert record["standing objects"] == {
        "objects": 1,
        "without candidates": [0.0, 0.0, 0.0],
        "candidates, median": 4.0,
        "candidates, mean": 4.0,
        "left behind, of these and the candidates": [0.0, 0.0, 0.0],
    }
    assert record["moving objects"] == {
        "objects": 2,
        "without candidates": [50.0, 0.0, 100.0],
        "candidates, median": 2.5,
        "candidates, mean": 2.5,
        "left behind, of these and the candidates": [44.4, 16.7, 100.0],
    }


def run(monkeypatch, *options):
    monkeypatch.setattr(sys, "argv", ["first_round", *options])
    with pytest.raises(SystemExit) as ended:
        run_measurement(study.measure, Args, study.__doc__)
    return ended.value.code


@pytest.mark.slow
def test_the_file_holds_the_objects_of_each_setting(tmp_path, monkeypatch):
    out = tmp_path / "record.json"
    assert run(monkeypatch, "--frames", "1", "--out", str(out)) == 0
    record = json.loads(out.read_text())
    frame = dataclasses.replace(city_frames(SENSOR, 1, Args.seed), reading=READING).frame(0)
    seen = np.array([np.any(inside_box(_current_within_limits(frame.points), box)) for box in frame.boxes])
    moving = np.hypot(*frame.boxes[:, 7:9].T) > 0.5
    expected = [(seen & ~moving).sum(), (seen & moving).sum()]
    for setting in study.SETTINGS:
        assert [record[setting][group]["objects"] for group in study.GROUPS] == expected
    ten, without, one = (record[name]["moving objects"]["candidates, mean"] for name in study.SETTINGS)
    assert ten > one > without


def _current_within_limits(points: np.ndarray) -> np.ndarray:
    x, y, z, _, lag = points.T
    return points[(lag == 0) & (np.abs(x) < 54) & (np.abs(y) < 54) & (z > -5) & (z < 3)]


def test_a_mistake_is_one_line(monkeypatch, capsys):
    assert run(monkeypatch, "--frames", "0") == 1
    assert capsys.readouterr().err == "first_round: error: --frames: got 0, expected at least 1\n"
