"""``fcos-lidar benchmark``: times of every stage, for checkpoints and exported detectors."""

import json
import re

import jax
import numpy as np
import pytest
from commands import command
from tiny_run import TINY_CONFIG, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.cli import benchmark
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    save_checkpoint(folder / "checkpoint", Checkpoint(TINY_CONFIG, TINY, untrained(TINY_CONFIG, TINY), 7))
    command("export --checkpoint", folder / "checkpoint", "--out", folder / "detector.fcos")
    for seed in range(2):
        np.save(folder / f"{seed}.npy", make_frame(seed, TINY).points)
    return folder


PARTS = ["prepare", "network", "postprocess"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parts"), [("checkpoint", PARTS), ("detector.fcos", [])])
def test_each_stage_and_the_whole_are_timed(home, tmp_path, capsys, name, parts):
    clouds, out = (home / "0.npy", home / "1.npy"), tmp_path / "times.json"
    command("benchmark", *clouds, "--repeats 3 --batch 1 --checkpoint", home / name, "--out", out)
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


def test_counts_the_operations_of_the_convolutions():
    model = build_detector(NUSCENES, NUSCENES_HDL32E)
    variables = jax.eval_shape(model.init, jax.random.key(0))
    sizes, operations = image_layout(NUSCENES_HDL32E, NUSCENES.model).level_sizes, 0
    pixels = dict(zip(("stage0", "stage1", "stage2", "stage3", "level6", "level7"), sizes, strict=True))
    pixels |= {f"{part}{i + 2}": n for part in ("level", "lateral", "output") for i, n in enumerate(sizes)}
    for path, leaf in jax.tree_util.tree_leaves_with_path(variables["params"]):
        words = [key.key for key in path]
        before_stride = words[2:3] == ["reduce"] and re.fullmatch("stage[123]_block0", words[1])
        if leaf.ndim in (2, 4):
            size = pixels.get(words[1].partition("_")[0], sizes[0])
            operations += 2 * size * (4 if before_stride else 1) * np.prod(leaf.shape)
    # XLA leaves out products with padding, and counts norms, sums and the padding of the predictions' channels.
    gflop = benchmark._network_gflop(TrainedDetector(model, variables))
    assert 1e9 * gflop == pytest.approx(operations, rel=0.03)


def test_clouds_of_another_sensor_get_one_warning(home, tmp_path, capsys):
    far = make_frame(0, TINY).points * np.array([100, 100, 1, 1, 1], np.float32)
    np.save(tmp_path / "far.npy", far)
    command("benchmark", tmp_path / "far.npy", home / "0.npy", "--repeats 1 --checkpoint", home / "detector.fcos")
    assert capsys.readouterr().err.count("warning: points do not fit sensor 'tiny'") == 1


def test_without_files_the_clouds_are_simulated(home, tmp_path, capsys):
    command("benchmark --repeats 1 --checkpoint", home / "detector.fcos", "--out", tmp_path / "a.json")
    assert "warning" not in capsys.readouterr().err
    record = json.loads((tmp_path / "a.json").read_text())
    assert list(record["stages"]) == ["clean", "detect", "whole"]
    assert list(record["throughput"]) == ["1"]
