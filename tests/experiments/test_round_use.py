"""Use of the extra rounds: clouds reduced to the first round, and the scores of networks with them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.changes import change
from experiments.studies import round_use as study
from experiments.studies.round_use import Args, FirstRound, measure
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames


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
