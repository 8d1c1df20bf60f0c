"""Rounds, sweeps and priority with local geometry: what the rows change, and what is refused."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.paper_tables.cells import changes_of
from experiments.paper_tables.scales import quarter, smoke
from experiments.studies import mrv_ablations
from experiments.studies.mrv_ablations import AblationArgs, by_motion, make_table
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.types import Detections

WHOLE = "five rounds of ten sweeps"
CHANGED = {
    "one round of ten sweeps": "projection.num_rounds=1",
    "without priority": "projection.prioritize_current=false",
    "five rounds of one sweep": "num_sweeps=1",
    "one round of one sweep": "num_sweeps=1, projection.num_rounds=1",
    "five rounds of ten sweeps with round offsets": "model.round_offsets=true",
    "without local geometry": "model.local_geometry=false",
}


@pytest.mark.parametrize("make_scale", [quarter, smoke])
def test_every_row_changes_the_named_part_only(tmp_path, make_scale):
    scale = make_scale(tmp_path)
    configs = {row.label: row.change(scale.base) for row in make_table().rows}
    whole = configs.pop(WHOLE)
    assert (whole.num_sweeps, whole.projection.num_rounds, whole.projection.prioritize_current) == (10, 5, True)
    assert {label: changes_of(config, whole) for label, config in configs.items()} == CHANGED
    for config in (whole, *configs.values()):
        assert config.optimizer == whole.optimizer


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
    scores, labels = np.linspace(1, 0.1, 6, dtype=np.float32), np.array([0, 0, 0, 0, 1, 0])
    found, kept = Detections(boxes, scores, labels, np.ones(6, bool), np.int32(0)), {}
    for moving in (True, False):
        selected, part = by_motion(found, frame, moving)
        kept[moving] = (np.flatnonzero(selected.valid).tolist(), part.boxes[:, 0].tolist())
    # The fourth is of another class than the object beside it, the last is near none: both count twice.
    assert kept == {True: ([0, 1, 3, 4, 5], [10, 30]), False: ([2, 3, 5], [13])}


def test_scores_by_motion_are_those_of_the_benchmark(monkeypatch, tmp_path):
    frames = [frame for frame in map(SimulatedFrames(TINY, 3).frame, range(3)) if len(frame.boxes)]
    perfect = []
    for frame in frames:
        boxes, number = frame.boxes.copy(), len(frame.boxes)
        boxes[:, 7] += np.where(np.hypot(boxes[:, 7], boxes[:, 8]) > 0.5, 0.5, 0.25)
        scores = np.linspace(0.9, 0.1, number, dtype=np.float32)
        perfect.append(Detections(boxes, scores, frame.labels, np.ones(number, bool), np.int32(0)))
    monkeypatch.setattr(mrv_ablations, "load_trained", lambda _: SimpleNamespace(config=quarter(tmp_path).base))
    monkeypatch.setattr(mrv_ablations, "detections", lambda *_: (perfect, frames))
    out = tmp_path / "tables"
    mrv_ablations.main(AblationArgs(by_motion=(Path("runs/five"),), out=out, runs=tmp_path))
    record = json.loads((out / "by_motion.json").read_text())["five"]
    assert [record[f"{motion} objects"]["mAP"] for motion in ("all", "moving", "standing")] == [1, 1, 1]
    errors = {motion: record[f"{motion} objects"]["velocity error of cars"] for motion in ("moving", "standing")}
    assert errors == {"moving": 0.5, "standing": 0.25}
    assert record["moving objects"]["AP"]["barrier"] == 0  # none of them moves
