"""Shipped weights are intact, small, match the current presets, and detect objects."""

import dataclasses
from pathlib import Path

import pytest

from experiments.studies.shipped_weights import CONFIGS
from fcos_lidar_jax.checkpoints import load_checkpoint
from fcos_lidar_jax.checkpoints.retention import find_checkpoint, shipped_checkpoints
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.inference.prediction import evaluate
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frame_set import unseen_frames

NAMES = sorted(shipped_checkpoints())


@pytest.mark.parametrize("name", NAMES)
def test_shipped_weights_are_small_and_match_the_preset(name):
    folder, config = shipped_checkpoints()[name], CONFIGS[name]
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 8 * 2**20
    shipped = load_checkpoint(folder)
    assert shipped.sensor == load_sensor(config.sensor)
    look = shipped.config.refinement
    if look is not None:  # which may have been trained alone
        look = dataclasses.replace(look, freeze_detector=False)
    assert dataclasses.replace(shipped.config, optimizer=config.optimizer, refinement=look) == config


@pytest.mark.slow
def test_shipped_weights_detect_on_unseen_streets():
    detector = load_detector("quickstart")
    assert evaluate(detector, unseen_frames(detector.sensor, 12)).summary["mean_ap"] > 0.4


def test_a_name_stands_for_shipped_weights_unless_a_folder_has_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_checkpoint(Path("quickstart")) == shipped_checkpoints()["quickstart"]
    (tmp_path / "quickstart").mkdir()
    assert find_checkpoint(Path("quickstart")) == Path("quickstart")


@pytest.mark.parametrize("name", NAMES)
def test_shipped_weights_contain_no_path_of_the_machine_that_made_them(name):
    for path in shipped_checkpoints()[name].rglob("*"):
        assert path.is_dir() or not any(
            root in path.read_bytes() for root in (b"/tmp/", b"/home/", b"/root/", b"/work")
        )
