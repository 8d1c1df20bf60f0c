"""The learning ladder: its trials are possible networks, and differ from the base in what they say."""

import json

import jax
import pytest
from linear_network import linear_network

from experiments.changes import SLIM
from experiments.studies import ladder
from experiments.studies.ladder import BASE, SENSOR, TRIALS, Args, measure
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import COMPACT

PARAMETERS = {
    "base": 1_265_726,
    "CenterPoint": 739_796,
    "local geometry": 1_288_574,
    "larger": 1_929_694,
    "larger, without local geometry": 1_887_870,
}


@pytest.mark.parametrize("name", TRIALS)
def test_every_trial_is_a_network_for_the_sector(name):
    config = TRIALS[name](BASE(SLIM(COMPACT)))
    detector = build_detector(config, SENSOR)
    parameters = count_parameters(jax.eval_shape(detector.init, jax.random.key(0))["params"])["total"]
    assert parameters == PARAMETERS[name]
    assert (config == BASE(SLIM(COMPACT))) == (name == "local geometry")
    assert config.optimizer == COMPACT.optimizer


def test_an_unknown_trial_is_refused_before_anything_is_trained(monkeypatch):
    monkeypatch.setattr(ladder, "trial", None)
    with pytest.raises(ValueError, match="--trials: got 'magic', expected some of base, CenterPoint"):
        measure(Args(trials=("base", "magic")))


@pytest.fixture
def _linear():
    with linear_network():
        yield


@pytest.mark.usefixtures("_linear")
def test_a_trial_is_trained_scored_and_summarised(tmp_path, monkeypatch, capsys):
    """Four steps on four frames with a linear network: that everything is there, not what it is."""
    for name, value in (("TRAIN_FRAMES", 4), ("TEST_FRAMES", 3), ("CURVE_FRAMES", 2)):
        monkeypatch.setattr(ladder, name, value)
    out = tmp_path / "ladder.json"
    args = Args(trials=("local geometry",), steps=4, work=tmp_path, out=out)
    measure(args)
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["trial"], row["seed"], len(row["curve"])) == ("local geometry", 0, 4)
    assert 0 <= row["mAP"] <= 1
    assert row["step_s"] > 0
    shapes = jax.eval_shape(build_detector(BASE(SLIM(COMPACT)), SENSOR).init, jax.random.key(0))
    assert row["parameters"] == sum(leaf.size for leaf in jax.tree.leaves(shapes["params"]))
    assert '"trial": "local geometry"' in capsys.readouterr().out
    monkeypatch.setattr(ladder, "trial", None)  # nothing is trained again
    measure(args)
    assert capsys.readouterr().out.count("| local geometry | 4 |") == 1
