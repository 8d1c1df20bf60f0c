"""Detections where moving objects were, and training losses, by hand."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.studies import older_points as study
from experiments.studies.older_points import Args, ghosts, measure, scores, training_losses
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.types import Detections

STILL = (0, 20, 0, 2, 2, 2, 0, 0, 0)
MOVING = (20, 0, 0, 2, 2, 2, 0, 10, 0)
"""Boxes x, y, z, l, w, h, yaw, vx, vy; the second was at x = 15 m half a second before."""


def at(*centres: tuple[float, float, float]) -> np.ndarray:
    """Boxes f32[n, 9] of one metre."""
    boxes = np.zeros((len(centres), 9), np.float32)
    boxes[:, :3], boxes[:, 3:6] = centres, 1
    return boxes


def frame(*boxes) -> Frame:
    """Cars without points."""
    boxes = np.array(boxes, np.float32).reshape(-1, 9)
    number = len(boxes)
    return Frame(np.zeros((0, 5), np.float32), boxes, np.zeros(number, np.int32), np.full(number, 9, np.int32))


def detected(boxes: np.ndarray, *ranks: float) -> Detections:
    """Cars with scores."""
    number, scored = len(boxes), np.array(ranks, np.float32)
    return Detections(boxes, scored, np.zeros(number, np.int32), np.ones(number, bool), np.int32(0))


@pytest.mark.parametrize(
    ("centre", "behind", "ahead"),
    [
        ((20.9, 0, 0), False, False),  # In the moving object.
        ((18.9, 0, 0), True, False),
        ((14.1, 0, 0), True, False),  # In it half a second before.
        ((13.9, 0, 0), False, False),  # Before all sweeps.
        ((18.0, 1.1, 0), False, False),  # Beside its way.
        ((18.0, 0, 1.1), False, False),  # Above it.
        ((25.4, 0, 0), False, True),
        ((0, 18.9, 0), False, False),  # Before an object that stands.
    ],
)
def test_ghosts_lie_where_an_object_was_and_none_is(centre, behind, ahead):
    truth = np.array([STILL, MOVING], np.float32)
    assert ghosts(at(centre), truth).tolist() == [behind]
    assert study.ahead(at(centre), truth).tolist() == [ahead]


def test_a_detection_in_another_object_is_no_ghost():
    follower = (17, 0, 0, 2, 2, 2, 0, 10, 0)
    truth = np.array([MOVING, follower], np.float32)
    assert ghosts(at((17, 0, 0), (18.5, 0, 0)), truth).tolist() == [False, True]


def test_ghosts_of_turned_objects_lie_against_their_velocity():
    diagonal = (0, 0, 0, 4, 1, 2, np.pi / 4, 5, 5)
    truth, way = np.array([diagonal], np.float32), np.sqrt(0.5)
    behind, beside = (-3 * way, -3 * way, 0), (-3 * way + way, -3 * way - way, 0)
    assert ghosts(at(behind, beside), truth).tolist() == [True, False]
    assert study.ahead(at((3 * way, 3 * way, 0), behind), truth).tolist() == [True, False]


def test_the_trail_of_a_leading_object_is_not_ahead_of_its_follower():
    leader, follower = (18, 0, 0, 2, 2, 2, 0, 10, 0), (8, 0, 0, 2, 2, 2, 0, 10, 0)
    truth = np.array([leader, follower], np.float32)
    assert ghosts(at((13, 0, 0), (11, 0, 0)), truth).tolist() == [True, False]
    assert study.ahead(at((13, 0, 0), (11, 0, 0)), truth).tolist() == [False, True]


def test_no_ghosts_without_objects_or_detections():
    assert ghosts(at((1, 2, 3)), np.zeros((0, 9), np.float32)).tolist() == [False]
    assert ghosts(np.zeros((0, 9), np.float32), np.array([MOVING], np.float32)).shape == (0,)


def test_scores_without_ghosts_are_those_of_the_other_detections():
    truth = frame(MOVING)
    both, only = at((17, 0, 0), (20, 0, 0)), at((20, 0, 0))
    found = detected(both, 0.9, 0.8)
    with_ghost = scores([found], [truth], None)
    without = scores([found], [truth], ghosts)
    assert without == scores([detected(only, 0.8)], [truth], None)
    assert with_ghost["AP"]["car"] < without["AP"]["car"] == 1
    assert found.valid.all()


def test_training_losses_are_means_over_the_positives_of_the_last_thousand_steps():
    rows = [
        {"step": s, "loss/total": 1.0, "loss/iou": 0.5, "loss/l1": 9.0, "positives": 1} for s in range(1, 2001)
    ]
    for row in rows[1000:]:
        row |= {"loss/l1": 1.0, "positives": 30} if row["step"] % 2 else {"loss/l1": 2.0, "positives": 10}
    metrics = [*rows, {"step": 2000, "test/mAP": 0.1}]
    assert training_losses(metrics) == {"positives": 20.0, "iou": 0.5, "l1": 1.25}


def test_each_run_is_measured_on_frames_with_its_sweeps(monkeypatch, tmp_path):
    asked = []

    def test_frames(split, num_sweeps):
        asked.append((split, num_sweeps))
        return num_sweeps

    monkeypatch.setattr(study, "quarter", lambda cache: SimpleNamespace(frames=test_frames))
    sweeps = {"ten": 10, "one": 1}
    monkeypatch.setattr(
        study, "load_trained", lambda path: SimpleNamespace(config=SimpleNamespace(num_sweeps=sweeps[path.name]))
    )
    behind, ahead = at((17, 0, 0), (20, 0, 0)), at((25, 0, 0), (20, 0, 0))
    monkeypatch.setattr(
        study, "detections", lambda _, n: ([detected({10: behind, 1: ahead}[n], 0.9, 0.8)], [frame(MOVING)])
    )
    monkeypatch.setattr(study, "read_metrics", lambda path: [])
    monkeypatch.setattr(study, "training_losses", lambda metrics: {})
    record = measure(Args(trained=(Path("runs/ten"), Path("runs/one")), frames=tmp_path))
    assert asked == [("test", 10), ("test", 1)]
    better = {name: {k: v["mAP"] for k, v in r.items() if k != "training losses"} for name, r in record.items()}
    ten, one = better["ten"], better["one"]
    assert ten["without ghosts"] > ten["all detections"] == ten["without detections ahead"]
    assert one["without detections ahead"] > one["all detections"] == one["without ghosts"]
