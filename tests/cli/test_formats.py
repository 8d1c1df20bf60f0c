"""Every format from the command line: prepare, train, evaluate and detect.

tests/cli/test_own_data.py covers the format ``folder``.
"""

import dataclasses
import json
import re
from pathlib import Path
from typing import get_args
from unittest.mock import Mock

import numpy as np
import pytest
from commands import command
from made_argoverse2 import make_argoverse2
from made_folder import make_folder
from made_kitti import make_kitti
from tiny_run import NETWORK_OPTIONS, SENSOR

import fcos_lidar_jax as fcos
from fcos_lidar_jax import progress
from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.data.argoverse2 import TO_NUSCENES
from fcos_lidar_jax.input_pipeline.open import Format
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, Sensor, sensor_to_json
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

STEPS = 1
Made = tuple[str, str, Path, tuple[str, ...]]
"""Options of the data, preset with its options, a point file, and the classes."""


def sensor_options(folder: Path, sensor: Sensor, max_points: int) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "sensor.json").write_text(json.dumps(sensor_to_json(sensor)))
    return f"--sensor {folder}/sensor.json --max-points {max_points}"


def nuscenes(root: Path) -> Made:
    options = sensor_options(root, SENSOR, 1024)
    command(f"synthesize --out {root}/data --scenes 2 --keyframes 3 --sensor {root}/sensor.json")
    cloud = next((root / "data" / "samples" / "LIDAR_TOP").iterdir())
    return f"--data-root {root}/data", f"quickstart {options}", cloud, NUSCENES_CLASSES


def kitti(root: Path) -> Made:
    coarse = dataclasses.replace(KITTI_HDL64E, num_columns=64)
    make_kitti(root, sensor=coarse)
    cloud = root / "training" / "velodyne" / "000000.bin"
    return f"--data-root {root}", f"kitti {sensor_options(root, coarse, 4096)}", cloud, KITTI_CLASSES


def argoverse2(root: Path) -> Made:
    coarse = dataclasses.replace(ARGOVERSE2, num_columns=64)
    make_argoverse2(root, sensor=coarse)
    cloud = next(root.rglob("sensors/lidar/*.feather"))
    return f"--data-root {root}", f"argoverse2 {sensor_options(root, coarse, 4096)}", cloud, ARGOVERSE2_CLASSES


def simulated(root: Path) -> Made:
    options = sensor_options(root, SENSOR, 1024)
    frames = fcos.open_frames(format="simulated", split="val", sensor=SENSOR)
    np.save(root / "cloud.npy", frames.frame(0).points)
    return "--format simulated", f"quickstart --no-copy-paste {options}", root / "cloud.npy", NUSCENES_CLASSES


MAKERS = (nuscenes, argoverse2, kitti, simulated)


OWN_CLASSES = {"person": "pedestrian", "post": "barrier", "vehicle": "car"}


def own_data(folder: Path, **sizes: int) -> tuple[Path, str]:
    """A data set in the format ``folder`` with the sensor of the quickstart; returns its root and its options."""
    root = make_folder(folder / "data", sensor=fcos.load_sensor("short_range"), **sizes)
    (folder / "map.json").write_text(json.dumps(OWN_CLASSES))
    return root, f"--class-map {folder}/map.json --data-root {root}"


def test_every_format_is_tried():
    assert {make.__name__ for make in MAKERS} | {"folder"} == set(get_args(Format))


@pytest.mark.slow
@pytest.mark.usefixtures("linear")
@pytest.mark.parametrize("make", MAKERS)
def test_prepares_trains_evaluates_and_detects(make, tmp_path, capsys):
    """The network does not depend on the format; ``tests/training`` trains FCOS-LiDAR's."""
    data, preset, cloud, classes = make(tmp_path / "data")
    run, scores, boxes = tmp_path / "run", tmp_path / "scores", tmp_path / "boxes.json"
    if make is not simulated:
        command("prepare", data)
    some = "--samples 0:4 --val-samples 0:2" if make is simulated else ""
    often = f"--steps {STEPS} --save-every {STEPS} --evaluate-every {STEPS}"
    command("train", preset, data, "--out", run, *NETWORK_OPTIONS, often, some)
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (record["steps"], Path(record["checkpoint"]).name) == (STEPS, f"{STEPS:08d}")
    command("evaluate", data, "--no-report --checkpoint", run, "--out", scores, "--samples 0:2" if some else "")
    summary = json.loads((scores / "metrics_summary.json").read_text())
    assert 0 <= summary["mean_ap"] <= 1
    assert ("nd_score" in summary) == (make is nuscenes)
    assert set(summary["mean_dist_aps"]) <= set(classes)
    assert "centre distance" in capsys.readouterr().out or make is nuscenes
    command("detect", cloud, "--checkpoint", run, "--out", boxes)
    [record] = json.loads(boxes.read_text())["files"]
    assert record["num_points"] > 100
    assert {box["label"] for box in record["boxes"]} <= set(classes)


def test_a_class_map_by_name_opens_the_same_frames_as_its_file(tmp_path, monkeypatch):
    argoverse2(tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    Path("map.json").write_text(json.dumps(TO_NUSCENES))
    Path("nuscenes").write_text(json.dumps({"PEDESTRIAN": "car"}))

    def opened(class_map):
        return DataOptions(tmp_path / "data", class_map=class_map).open(QUICKSTART, split="train")

    frames = [opened(given) for given in ("nuscenes", "map.json", "./nuscenes")]
    by_name, by_file, by_own_file = ([f.labels(i).tolist() for i in range(len(f))] for f in frames)
    assert frames[0].fingerprint() == frames[1].fingerprint()
    assert by_name == by_file != by_own_file
    known = "the class maps of format argoverse2: nuscenes$"
    for given, message in ((None, "a class map; "), ("nuscens", "no such file, expected .* one of ")):
        with pytest.raises(ValueError, match=message + known):
            opened(given)


ORDER = "(max_points); older sweeps go first, then random points"
COUNTED = f"points left out in total: the detector takes at most 4096 per cloud {ORDER}"


@pytest.mark.slow
def test_points_that_are_left_out_are_told_by_every_command(tmp_path, capsys):
    root, data = own_data(tmp_path, train=2, val=1)
    rng = np.random.default_rng(0)
    dense = np.load(root / "clouds" / "000.npy")
    dense = np.concatenate(
        [np.full((5, 4), np.nan), dense, dense[rng.integers(0, len(dense), 4000)] + rng.normal(0, 0.05, (4000, 4))]
    )
    np.save(root / "clouds" / "000.npy", dense.astype(np.float32))
    np.save(root / "clouds" / "002.npy", dense.astype(np.float32))

    def told():
        progress._told.clear()  # commands of one test print notes again
        named = capsys.readouterr().err
        return re.sub(r"usable points of \S*00[02]\S* are", "usable points of NAME are", named).splitlines()

    told()
    command("detect", root / "clouds", "--checkpoint quickstart --out", tmp_path / "boxes.json")
    by_command = json.loads((tmp_path / "boxes.json").read_text())["files"]
    assert by_command[0]["num_truncated"] == by_command[2]["num_truncated"] > 0
    usable = by_command[0]["num_truncated"] + 4096  # so that the numbers of the message add up
    assert usable <= len(dense) - 5
    left_out = f"{by_command[0]['num_truncated']} of {usable} usable points of NAME are left out"
    truncated = f"clouds are truncated: {left_out}, since the detector takes at most 4096 {ORDER}"
    once, twice = (f"{number * by_command[0]['num_truncated']} {COUNTED}" for number in (1, 2))
    lines = told()
    [dense_line] = (line for line in lines if "points per cell, expected about 1" in line)
    first, result, *_, last = (line for line in lines if "files " in line or line in (truncated, once, twice))
    assert (first, result[:9], last) == (truncated, "files 1/3", twice)
    command("evaluate", data, "--split train --checkpoint quickstart --no-report --out", tmp_path / "scores")
    assert [line for line in told() if "at most 4096" in line] == [truncated, once]
    command("stream", root / "clouds", "--checkpoint quickstart --out", tmp_path / "boxes.jsonl")
    lines = told()
    assert [line for line in lines if "at most 4096" in line] == [truncated, twice]
    assert dense_line in lines  # counted before the truncation


@pytest.fixture
def messages(tmp_path, capsys, monkeypatch):
    """``messages(command)`` runs a command on own data up to the training or detection; returns its messages."""
    root, data = own_data(tmp_path, train=2, val=1)
    for name in ("train.train", "evaluate.run_detector"):
        monkeypatch.setattr(f"fcos_lidar_jax.cli.{name}", Mock(side_effect=KeyboardInterrupt))

    def run(line: str, splits: dict[str, list[str]] | None) -> str:
        (root / "splits.json").unlink(missing_ok=True)
        if splits is not None:
            (root / "splits.json").write_text(json.dumps(splits))
        with pytest.raises(AssertionError):  # interrupted
            command(line, data, "--out", tmp_path / "out")
        return capsys.readouterr().err

    return run


TRAINING, EVALUATION = "train quickstart --no-copy-paste", "evaluate --checkpoint quickstart"
A, B, C = (f"{i:03d}" for i in range(3))


@pytest.mark.slow
def test_warns_if_frames_are_both_trained_and_evaluated_on(messages):
    overlap = "of the 2 evaluation frames are also training frames"
    assert f"1 {overlap}" in messages(TRAINING, {"train": [A, B], "val": [B, C]})
    assert "also training frames" not in messages(TRAINING, {"train": [A], "val": [B, C]})
    assert "data: no split val: evaluating all, the only split" in messages(EVALUATION, {"all": [A, B, C]})
    assert "no split val" not in messages(EVALUATION, {"train": [A], "val": [B, C]})
    for line, expected in ((TRAINING, "training on all 3 frames"), (EVALUATION, "evaluating all 3 frames")):
        assert f"data: no splits: {expected}" in messages(line, None)


@pytest.mark.slow
def test_prepares_into_another_folder_and_evaluates_given_detections(tmp_path, monkeypatch):
    """For data on a read-only disk; training finds the objects there, and the report names the frames."""
    root, data = own_data(tmp_path, train=2, val=2)
    prepared = f"{data} --index {tmp_path}/prepared"
    command("prepare", prepared)
    assert not (root / ".fcos_lidar").exists()
    monkeypatch.setattr("fcos_lidar_jax.cli.train.train", trained := Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(AssertionError):  # interrupted
        command("train quickstart", prepared, "--out", tmp_path / "run")
    assert trained.call_args.kwargs["objects"].folder.is_relative_to(tmp_path / "prepared")
    out, evaluate = tmp_path / "scores", f"evaluate {data} --checkpoint quickstart --out"
    command(evaluate, out)
    for line in ("The worst sample", "The best sample"):
        assert re.search(rf"{line}.*00[23]", (out / "report.html").read_text())
    record = json.loads((out / "detections.json").read_text())
    record["frames"][0]["boxes"] = []
    (tmp_path / "given.json").write_text(json.dumps(record))
    command(evaluate, out, "--no-report --results", tmp_path / "given.json")
    assert (out / "detections.json").read_bytes() == (tmp_path / "given.json").read_bytes()


def test_boxes_of_simulated_frames_are_not_counted(monkeypatch, capsys):
    """To count the boxes of left out classes, all frames would have to be simulated."""
    monkeypatch.setattr(SimulatedFrames, "frame", Mock(side_effect=AssertionError))
    config = dataclasses.replace(QUICKSTART, classes=("car", "bus"))
    frames = DataOptions(format="simulated").open(config, split="train")
    assert frames.classes == ("car", "bus")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("left out boxes of classes that the detector does not have: truck, trailer")
