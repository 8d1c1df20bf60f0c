"""Weights for a larger network: it detects the same, and can learn to use its new channels."""

import dataclasses

import jax
import numpy as np
import pytest
from tiny_run import CONFIG, SENSOR

from experiments.studies import widened_weights
from experiments.studies.widened_weights import widened
from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.models import build_detector

MODEL = dataclasses.replace(CONFIG.model, local_geometry=True, backbone_widths=(4, 4, 4, 4))
LARGER = dataclasses.replace(
    MODEL,
    stem=dataclasses.replace(MODEL.stem, out_channels=12),
    backbone_blocks=(2, 1, 1, 1),
    backbone_widths=(6, 4, 4, 8),
    fpn_channels=10,
    head_channels=12,
)
SMALL, LARGE = (build_detector(dataclasses.replace(CONFIG, model=model), SENSOR) for model in (MODEL, LARGER))


def drawn(detector, seed):
    """Random variables; statistics and norms are not those of an untrained network either."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf) + rng.uniform(0.1, 0.5, leaf.shape).astype(np.float32),
        detector.init(jax.random.key(seed)),
    )


@pytest.mark.slow
def test_the_command_replaces_the_weights_only_if_they_predict_the_same(tmp_path, monkeypatch, capsys):
    config = dataclasses.replace(CONFIG, model=MODEL)
    before = Checkpoint(config, SENSOR, jax.tree.map(np.float16, drawn(SMALL, 3)), 5)
    save_checkpoint(tmp_path / "hdl32e", before)
    monkeypatch.setattr(widened_weights, "SHIPPED", tmp_path)
    wrong = dataclasses.replace(LARGER, stem=dataclasses.replace(LARGER.stem, channels_per_type=4))
    files = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    monkeypatch.setitem(widened_weights.CONFIGS, "hdl32e", dataclasses.replace(config, model=wrong))
    with pytest.raises(ValueError, match="hdl32e: the larger network predicts otherwise, by"):
        widened_weights.main(widened_weights.Args(name="hdl32e"))
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == files
    monkeypatch.setitem(widened_weights.CONFIGS, "hdl32e", dataclasses.replace(config, model=LARGER))
    widened_weights.main(widened_weights.Args(name="hdl32e"))
    after = load_checkpoint(tmp_path / "hdl32e")
    assert (after.step, after.config.model) == (5, LARGER)
    assert "parameters became" in capsys.readouterr().err


def test_a_smaller_network_is_refused():
    with pytest.raises(ValueError, match=r"linear1'\]: got \(32, 8\), expected at most \(32, 4\)"):
        widened({"linear1": np.zeros((32, 8))}, {"linear1": np.zeros((32, 4))})
    with pytest.raises(ValueError, match=r"'more'.*not in the larger network"):
        widened({"more": np.zeros(2)}, {"other": np.zeros(2)})
