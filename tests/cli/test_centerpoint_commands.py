"""CenterPoint with the commands train and export."""

import numpy as np
import pytest
from commands import assert_one_line_error, command
from test_formats import SENSOR, sensor_options
from tiny_peer import NETWORK_OPTIONS
from tiny_run import bits

import fcos_lidar_jax as fcos
from fcos_lidar_jax.centerpoint import CenterPointConfig
from fcos_lidar_jax.checkpoints import load_checkpoint
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training.metrics_log import read_metrics

pytestmark = pytest.mark.slow

STEPS = 20


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A run of twenty steps on two frames."""
    folder = tmp_path_factory.mktemp("peer")
    preset = f"centerpoint_compact --no-copy-paste --no-augment {sensor_options(folder, SENSOR, 1024)}"
    often = f"--steps {STEPS} --save-every {STEPS} --evaluate-every {STEPS} --samples 0:2 --val-samples 0:2"
    command("train", preset, "--format simulated --out", folder / "run", *NETWORK_OPTIONS, often)
    np.save(folder / "cloud.npy", make_frame(0, SENSOR).points)
    return folder


def test_the_loss_falls_and_is_the_weighted_sum_of_its_parts(home):
    lines = [line for line in read_metrics(home / "run") if "loss/total" in line]
    assert len(lines) == STEPS
    totals = [line["loss/total"] for line in lines]
    assert np.mean(totals[-3:]) < 0.7 * np.mean(totals[:3])
    assert totals[0] == pytest.approx(lines[0]["loss/classification"] + 0.25 * lines[0]["loss/l1"], rel=1e-5)
    assert 0 <= lines[-1]["positive_iou"] <= 1
    assert (home / "run" / "loss.png").is_file()


def test_checkpoint_and_exported_file_hold_the_detector(home):
    trained = load_trained(home / "run")
    checkpoint = load_checkpoint(home / "run")
    assert checkpoint.config == trained.config
    assert type(checkpoint.config) is CenterPointConfig
    assert bits(checkpoint.variables) == bits(trained.variables)
    command("export --checkpoint", home / "run", "--out", home / "detector.fcos")
    exported = fcos.load_detector(home / "detector.fcos")
    assert exported.config == trained.config
    by_file, by_weights = (d(home / "cloud.npy") for d in (exported, trained))
    assert len(by_weights) > 0
    for name in ("boxes", "scores", "labels"):  # bit-identical with compiler optimisation
        np.testing.assert_allclose(getattr(by_file, name), getattr(by_weights, name), atol=1e-4)


def test_onnx_and_openvino_reject_it_in_one_line(home, tmp_path, capsys):
    run, cloud, out = (str(path) for path in (home / "run", home / "cloud.npy", tmp_path / "out"))
    export = ["export", "--checkpoint", run, "--network-only", "--format", "onnx", "--out", out]
    detect = ["detect", cloud, "--checkpoint", run, "--backend", "openvino", "--out", out]
    for args in (export, detect):
        assert_one_line_error(
            capsys, args, "ONNX: got the detector 'centerpoint_compact', expected one on range images"
        )
    assert not (tmp_path / "out").exists()
