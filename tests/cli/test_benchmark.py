"""``fcos-lidar benchmark``: times of every stage, for checkpoints and exported detectors."""

import json

import numpy as np
import pytest
from commands import command
from tiny_run import save_untrained

from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    save_untrained(folder / "checkpoint")
    command("export --checkpoint", folder / "checkpoint", "--out", folder / "detector.fcos")
    for seed in range(2):
        np.save(folder / f"{seed}.npy", make_frame(seed, TINY).points)
    return folder


PARTS = ["prepare", "network", "postprocess"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parts"), [("checkpoint", PARTS), ("detector.fcos", [])])
def test_each_stage_and_the_whole_are_timed(home, tmp_path, capsys, name, parts):
    clouds, out = (home / "0.npy", home / "1.npy"), tmp_path / "times.json"
    command("benchmark", *clouds, "--repeats 1 --batch 1 --checkpoint", home / name, "--out", out)
    record = json.loads(out.read_text())
    stages = record["stages"]
    assert list(stages) == ["read", "clean", *parts, "detect", "whole"]
    assert all(0 < times["median_ms"] <= times["p95_ms"] for times in stages.values())
    assert stages["whole"]["median_ms"] > stages["read"]["median_ms"]
    times = record["throughput"].pop("1")
    assert record["throughput"] == {}
    assert times["clouds_per_s"] == pytest.approx(1e3 / times["median_ms"], abs=0.01)
    assert record["clouds"] == 2
    assert record["points"] == round(sum(len(np.load(file)) for file in clouds) / 2)
    assert record["cores"] >= 1
    if parts:
        speed = record["network"]
        assert speed["gflops"] == pytest.approx(1e3 * speed["gflop"] / stages["network"]["median_ms"], rel=1e-3)
        assert speed["share"] == pytest.approx(speed["gflops"] / speed["product_gflops"], abs=1e-3)
        assert speed["gflop"] > 0
    else:
        assert "network" not in record
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed[2 : 2 + len(stages)]] == list(stages)


def test_without_files_the_clouds_are_simulated(home, tmp_path, capsys):
    command("benchmark --repeats 1 --checkpoint", home / "detector.fcos", "--out", tmp_path / "a.json")
    assert "warning" not in capsys.readouterr().err
    record = json.loads((tmp_path / "a.json").read_text())
    assert list(record["stages"]) == ["clean", "detect", "whole"]
    assert list(record["throughput"]) == ["1"]
