"""The weights that come with the package are whole, small, of today's preset, and find what they should."""

import dataclasses
from pathlib import Path

import numpy as np

from fcos_lidar_jax.cli import main
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frame_set import fresh_streets, unseen_frames
from fcos_lidar_jax.trainer import evaluate
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.checkpoints import find_checkpoint, shipped_checkpoints


def test_shipped_weights_are_small_and_of_todays_preset():
    folder = shipped_checkpoints()["quickstart"]
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 4 * 2**20
    shipped, (preset, _) = load_checkpoint(folder), fresh_streets(QUICKSTART, steps=1)
    assert shipped.sensor == load_sensor(QUICKSTART.sensor)
    same_training = dataclasses.replace(shipped.config, optimizer=preset.optimizer)
    assert same_training == preset


def test_shipped_weights_detect_on_unseen_streets():
    detector = load_detector("quickstart")
    assert evaluate(detector, unseen_frames(detector.sensor, 12)).summary["mean_ap"] > 0.4


def test_a_name_stands_for_shipped_weights_where_no_folder_has_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert find_checkpoint(Path("quickstart")) == shipped_checkpoints()["quickstart"]
    (tmp_path / "quickstart").mkdir()
    assert find_checkpoint(Path("quickstart")) == Path("quickstart")
    np.save(tmp_path / "cloud.npy", np.ones((20, 4), np.float32))
    args = ["detect", str(tmp_path / "cloud.npy"), "--out", str(tmp_path / "boxes.json")]
    assert main([*args, "--checkpoint", "quickstart"]) == 1
    assert "quickstart" in capsys.readouterr().err


def test_shipped_weights_name_no_folder_of_the_machine_that_made_them():
    for path in shipped_checkpoints()["quickstart"].rglob("*"):
        assert path.is_dir() or not any(
            root in path.read_bytes() for root in (b"/tmp/", b"/home/", b"/root/", b"/work")
        )
