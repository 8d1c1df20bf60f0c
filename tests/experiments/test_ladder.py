"""The learning ladder: its trials are possible networks, and differ from the base in what they say."""

import json

import jax
import numpy as np
import pytest
import tiny_run
from linear_network import linear_network

from experiments.changes import LONE_LOOK, SLIM, change
from experiments.ledger import RESULTS
from experiments.studies import ladder
from experiments.studies.ladder import BASE, SENSOR, TRIALS, Args, measure
from fcos_lidar_jax.checkpoints import load_checkpoint
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import COMPACT

COMMITTED = {row["trial"]: row["parameters"] for row in json.loads((RESULTS / "ladder.json").read_text())["rows"]}


def test_the_trials_are_the_networks_of_the_committed_scores():
    base = BASE(SLIM(COMPACT))
    for name, parameters in COMMITTED.items():
        config = TRIALS[name](base)
        assert (config == base) == (name == "local geometry")
        assert (config.optimizer == COMPACT.optimizer) == (name not in ladder.AFTERWARDS)
        shapes = jax.eval_shape(build_detector(config, SENSOR).init, jax.random.key(0))
        assert count_parameters(shapes["params"])["total"] == parameters, name


@pytest.mark.slow
def test_a_trial_is_trained_scored_and_summarised(tmp_path, monkeypatch, capsys):
    """Two steps on two small frames with a linear network: that everything is there, not what it is."""
    again = {"larger, looked at again": ladder.Afterwards("larger", LONE_LOOK, updates=2)}
    sizes = {"TRAIN_FRAMES": 2, "TEST_FRAMES": 2, "CURVE_FRAMES": 1, "AFTERWARDS": again}
    sizes |= {"SENSOR": tiny_run.SENSOR, "BASE": lambda config: change(max_points=1024)(BASE(config))}
    for name, value in sizes.items():
        monkeypatch.setattr(ladder, name, value)
    out = tmp_path / "ladder.json"
    args = Args(trials=("larger", "larger, looked at again"), steps=2, work=tmp_path, out=out)
    with linear_network():
        measure(args)
        folders = (tmp_path / f"{name}_2_0" for name in ("larger", "larger_looked_at_again"))
        first, after = (load_checkpoint(folder).variables["params"] for folder in folders)
    rows = json.loads(out.read_text())["rows"]
    assert [(row["trial"], row["seed"], len(row["curve"])) for row in rows] == [
        ("larger", 0, 2),
        ("larger, looked at again", 0, 0),
    ]
    assert all(0 <= row["mAP"] <= 1 and row["step_s"] > 0 for row in rows)
    after.pop("refinement")
    jax.tree.map(np.testing.assert_array_equal, first, after)  # frozen
    assert '"trial": "larger"' in capsys.readouterr().out
    monkeypatch.setattr(ladder, "trial", None)  # nothing is trained again
    measure(args)
    assert capsys.readouterr().out.count("| larger | 2 |") == 2  # in both tables
