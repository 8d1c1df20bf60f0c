"""The benchmark command: a figure for every stage, of checkpoints and exported detectors."""

import json

import numpy as np
import pytest
from commands import assert_one_line_error, command
from tiny_run import TINY_CONFIG, untrained

from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import Checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    save_checkpoint(folder / "checkpoint", Checkpoint(TINY_CONFIG, TINY, untrained(TINY_CONFIG, TINY), 7))
    command("export --checkpoint", folder / "checkpoint", "--out", folder / "detector.fcos")
    for seed in range(2):
        np.save(folder / f"{seed}.npy", make_frame(seed, TINY).points)
    return folder


PARTS = ["projection", "network", "postprocess"]


@pytest.mark.parametrize(("name", "parts"), [("checkpoint", PARTS), ("detector.fcos", [])])
def test_each_stage_and_the_whole_are_timed(home, tmp_path, capsys, name, parts):
    clouds = home / "0.npy", home / "1.npy"
    out = tmp_path / "times.json"
    command("benchmark", *clouds, "--repeats 3 --batch 1 --checkpoint", home / name, "--out", out)
    record = json.loads(out.read_text())
    stages = record["stages"]
    assert list(stages) == ["read", "clean", *parts, "detect", "whole"]
    assert all(0 < times["median_ms"] <= times["p95_ms"] for times in stages.values())
    assert stages["whole"]["median_ms"] > stages["read"]["median_ms"]
    (batch,) = record["throughput"].items()
    assert batch[0] == "1"
    assert batch[1]["clouds_per_s"] == pytest.approx(1e3 / batch[1]["median_ms"], abs=0.01)
    assert record["clouds"] == 2
    assert record["points"] == round(sum(len(np.load(file)) for file in clouds) / 2)
    assert record["cores"] >= 1
    shown = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in shown[2 : 2 + len(stages)]] == list(stages)


def test_without_files_the_clouds_are_simulated(home, tmp_path):
    command("benchmark --repeats 1 --checkpoint", home / "detector.fcos", "--out", tmp_path / "a.json")
    record = json.loads((tmp_path / "a.json").read_text())
    assert list(record["stages"]) == ["clean", "detect", "whole"]
    assert list(record["throughput"]) == ["1"]


def test_several_clouds_at_once(home, tmp_path):
    options = "--repeats 1 --batch 1 2 --checkpoint"
    command("benchmark", home / "0.npy", options, home / "checkpoint", "--out", tmp_path / "a.json")
    record = json.loads((tmp_path / "a.json").read_text())
    assert list(record["throughput"]) == ["1", "2"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--repeats 0", "--repeats: got 0, expected at least 1"),
        ("--batch 0", "--batch: got 0, expected at least 1"),
        ("--batch 2", "batch size: got 2, expected 1"),
        ("none.npy", "none.npy: no such file"),
    ],
)
def test_mistakes_get_one_line(home, capsys, options, message):
    words = ["benchmark", *options.split(), "--checkpoint", str(home / "detector.fcos")]
    assert_one_line_error(capsys, words, message)
