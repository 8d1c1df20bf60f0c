"""Use of the extra rounds: clouds reduced to the first round, and the scores of networks with them."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.changes import change
from experiments.studies import round_use as study
from experiments.studies.round_use import Args, FirstRound, by_motion, measure
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.types import Detections


@pytest.mark.parametrize("prioritize_current", [True, False])
def test_reduced_clouds_have_the_same_first_round_and_nothing_else(prioritize_current):
    frames = SimulatedFrames(TINY, 1, reading=CloudReading(3))
    whole, reduced = frames.frame(0).points, FirstRound(frames, prioritize_current).frame(0).points
    before, after = (
        project_points(p, np.ones(len(p), bool), TINY, num_rounds=2, prioritize_current=prioritize_current)
        for p in (whole, reduced)
    )
    assert (before.point_index[..., 1] >= 0).any()
    assert (after.point_index[..., 1] == -1).all()
    np.testing.assert_array_equal(after.features[..., 0], before.features[..., 0])
    assert len(reduced) == np.sum(before.point_index[..., 0] >= 0) < len(whole)


def test_networks_with_several_rounds_are_also_scored_without_the_later_ones(monkeypatch, tmp_path):
    config = study.quarter(tmp_path).base

    def load(path: Path):
        rounds = {"five": 5, "one": 1}[path.name]
        return SimpleNamespace(config=change(projection__num_rounds=rounds)(config))

    monkeypatch.setattr(study, "load_trained", load)
    monkeypatch.setattr(study, "scores", lambda detector, frames: type(frames).__name__)
    record = measure(Args(trained=(Path("runs/five"), Path("runs/one")), frames=tmp_path))
    assert record == {
        "five": {"all rounds": "NewestSweeps", "first round only": "FirstRound"},
        "one": {"all rounds": "NewestSweeps"},
    }


def test_detections_are_split_with_the_objects_they_belong_to():
    frame = SimulatedFrames(TINY, 1).frame(0)
    truth = np.zeros((3, 9), np.float32)
    truth[:, 0], truth[:, 3:6] = (10, 13, 30), 1
    truth[0, 7] = 5.0  # moves; the second is of the same class and stands, the third of another class and moves
    truth[2, 8] = -0.6
    labels = np.array([0, 0, 1], np.int32)
    frame = dataclasses.replace(frame, boxes=truth, labels=labels, num_points=np.full(3, 9, np.int32))
    boxes = np.zeros((6, 9), np.float32)
    boxes[:, 0] = 10.1, 11.4, 11.6, 30.0, 30.1, 60.0
    found = Detections(
        boxes,
        np.linspace(1, 0.1, 6, dtype=np.float32),
        np.array([0, 0, 0, 0, 1, 0]),
        np.arange(6) < 6,
        np.int32(0),
    )
    kept = {}
    for moving in (True, False):
        selected, part = by_motion(found, frame, moving)
        kept[moving] = (np.flatnonzero(selected.valid).tolist(), part.boxes[:, 0].tolist())
    # The fourth is of another class than the object beside it, the last is near none: both count twice.
    assert kept == {True: ([0, 1, 3, 4, 5], [10, 30]), False: ([2, 3, 5], [13])}


def test_scores_by_motion_are_those_of_the_benchmark(monkeypatch):
    frames = [frame for frame in map(SimulatedFrames(TINY, 3).frame, range(3)) if len(frame.boxes)]
    perfect = []
    for frame in frames:
        boxes = frame.boxes.copy()
        moving = np.hypot(boxes[:, 7], boxes[:, 8]) > 0.5
        boxes[:, 7] += np.where(moving, 0.5, 0.25)
        number = len(boxes)
        scores = np.linspace(0.9, 0.1, number, dtype=np.float32)
        perfect.append(Detections(boxes, scores, frame.labels, np.ones(number, bool), np.int32(0)))
    monkeypatch.setattr(study, "detections", lambda *_: (perfect, frames))
    record = study.scores(None, None)
    assert record["moving cars"] == {"AP": 1.0, "velocity error": 0.5}
    assert record["standing cars"] == {"AP": 1.0, "velocity error": 0.25}
    assert 0.25 < record["cars"]["velocity error"] < 0.5
    assert record["AP"]["car"] == 1
    # The mAP by motion is over the classes with such objects, the benchmark's over all ten.
    labels = np.concatenate([frame.labels for frame in frames])
    moves = np.concatenate([np.hypot(frame.boxes[:, 7], frame.boxes[:, 8]) > 0.5 for frame in frames])
    assert len(set(labels[moves])) < 10
    for motion, present in (("moving objects", labels[moves]), ("standing objects", labels[~moves])):
        by_class = {name: float(label in present) for label, name in enumerate(NUSCENES_CLASSES)}
        assert record[motion] == {"mAP": 1.0, "AP": by_class}
