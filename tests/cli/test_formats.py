"""Every format from the command line: prepare, train, evaluate, detect; and the same boxes in every way.

The folder of own data is that of tests/cli/test_own_data.py.
"""

import contextlib
import dataclasses
import json
import re
from pathlib import Path
from typing import get_args
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from commands import command
from made_argoverse2 import make_argoverse2
from made_folder import make_folder
from made_kitti import make_kitti
from tiny_run import NETWORK_OPTIONS, SENSOR

import fcos_lidar_jax as fcos
from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import InMemoryFrames
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.input_pipeline.open import Format
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, Sensor, sensor_to_json
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training.run import train

STEPS = 20
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
    coarse = dataclasses.replace(KITTI_HDL64E, num_columns=256)
    make_kitti(root, sensor=coarse)
    cloud = root / "training" / "velodyne" / "000000.bin"
    return f"--data-root {root}", f"kitti {sensor_options(root, coarse, 16384)}", cloud, KITTI_CLASSES


def argoverse2(root: Path) -> Made:
    coarse = dataclasses.replace(ARGOVERSE2, num_columns=64)
    make_argoverse2(root, sensor=coarse)
    cloud = next(root.rglob("sensors/lidar/*.feather"))
    return f"--data-root {root}", f"argoverse2 {sensor_options(root, coarse, 8192)}", cloud, ARGOVERSE2_CLASSES


def simulated(root: Path) -> Made:
    options = sensor_options(root, SENSOR, 1024)
    frames = fcos.open_frames(format="simulated", split="val", sensor=SENSOR)
    np.save(root / "cloud.npy", frames.frame(0).points)
    return "--format simulated", f"quickstart --no-copy-paste {options}", root / "cloud.npy", NUSCENES_CLASSES


MAKERS = (nuscenes, argoverse2, kitti, simulated)


def test_every_format_is_tried():
    assert {make.__name__ for make in MAKERS} | {"folder"} == set(get_args(Format))


@pytest.mark.parametrize("make", MAKERS)
def test_prepares_trains_evaluates_and_detects(make, tmp_path, capsys):
    data, preset, cloud, classes = make(tmp_path / "data")
    run, scores, boxes = tmp_path / "run", tmp_path / "scores", tmp_path / "boxes.json"
    if make is not simulated:
        command("prepare", data)
    some = "--samples 0:4 --val-samples 0:2" if make is simulated else ""
    often = f"--steps {STEPS} --save-every {STEPS} --evaluate-every {STEPS}"
    command("train", preset, data, "--out", run, *NETWORK_OPTIONS, often, some)
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (record["steps"], Path(record["checkpoint"]).name) == (STEPS, f"{STEPS:08d}")
    command("evaluate", data, "--checkpoint", run, "--out", scores, "--samples 0:2" if some else "")
    summary = json.loads((scores / "metrics_summary.json").read_text())
    assert 0 <= summary["mean_ap"] <= 1
    assert ("nd_score" in summary) == (make is nuscenes)
    assert set(summary["mean_dist_aps"]) <= set(classes)
    assert "centre distance" in capsys.readouterr().out or make is nuscenes
    assert (scores / "report.html").read_text().startswith("<!doctype html>")
    command("detect", cloud, "--checkpoint", run, "--out", boxes)
    [record] = json.loads(boxes.read_text())["files"]
    assert record["num_points"] > 100
    assert {box["label"] for box in record["boxes"]} <= set(classes)


def test_the_same_cloud_gives_the_same_boxes_in_every_way(tmp_path):
    """A folder's cloud of more points than the detector takes, by the command, the evaluation and Python."""
    root = tmp_path / "data"
    make_folder(root, train=2, val=1, sensor=fcos.load_sensor("short_range"))
    rng = np.random.default_rng(0)
    dense = np.load(root / "clouds" / "000.npy")
    dense = np.concatenate([dense, dense[rng.integers(0, len(dense), 4000)] + rng.normal(0, 0.05, (4000, 4))])
    np.save(root / "clouds" / "000.npy", dense.astype(np.float32))
    names = {"person": "pedestrian", "post": "barrier", "vehicle": "car"}
    (tmp_path / "map.json").write_text(json.dumps(names))
    command("detect", root / "clouds", "--checkpoint quickstart --out", tmp_path / "boxes.json")
    by_command = json.loads((tmp_path / "boxes.json").read_text())["files"]
    assert by_command[0]["num_truncated"] > 0
    command(
        *("evaluate --data-root", root, "--class-map", tmp_path / "map.json", "--split train"),
        *("--checkpoint quickstart --out", tmp_path / "scores", "--no-report"),
    )
    evaluated = json.loads((tmp_path / "scores" / "detections.json").read_text())["frames"]
    detector = fcos.load_detector("quickstart")
    for i, frame in enumerate(evaluated):
        assert frame["boxes"] == by_command[i]["boxes"]
        dense = frame["name"] == "000"
        with pytest.warns(UserWarning, match="share a cell") if dense else contextlib.nullcontext():
            found = detector(np.load(root / "clouds" / f"{frame['name']}.npy"))
        count = int(found.valid.sum())
        assert count == len(frame["boxes"]) > 0
        assert [box["box"] for box in frame["boxes"]] == found.boxes[:count].tolist()
        assert [box["score"] for box in frame["boxes"]] == found.scores[:count].tolist()


def test_a_cloud_of_another_sensor_is_told_in_one_line(tmp_path, capsys):
    cloud = make_frame(0, fcos.load_sensor("nuscenes_hdl32e")).points
    np.save(tmp_path / "cloud.npy", cloud)
    command("detect", tmp_path / "cloud.npy", "--checkpoint quickstart --out", tmp_path / "boxes.json")
    [line] = [line for line in capsys.readouterr().err.splitlines() if "hardly of" in line]
    assert line.startswith("warning: ")
    command("project", tmp_path / "cloud.npy", "--sensor short_range --out", tmp_path / "image.npz")
    assert f"warning: {tmp_path / 'cloud.npy'}: points hardly of" in capsys.readouterr().err
    command("project", tmp_path / "cloud.npy", "--out", tmp_path / "image.npz")
    assert capsys.readouterr().err == ""


def test_data_without_splits_are_told_where_all_frames_serve_both_ends(tmp_path, capsys, monkeypatch):
    root = tmp_path / "data"
    make_folder(root, train=2, val=1, sensor=fcos.load_sensor("short_range"))
    (tmp_path / "map.json").write_text(json.dumps({"person": "pedestrian", "post": "barrier", "vehicle": "car"}))
    data = f"--class-map {tmp_path}/map.json --data-root {root}"
    train_it = f"train quickstart --no-copy-paste {data} --out"
    evaluate_it = f"evaluate {data} --checkpoint quickstart --out"

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("fcos_lidar_jax.cli.train.train", stop)
    monkeypatch.setattr("fcos_lidar_jax.cli.evaluate.write_predictions", stop)
    for name, splits in (("with", True), ("without", False)):
        if not splits:
            (root / "splits.json").unlink()
        for args, said in ((train_it, "training on all 3 frames"), (evaluate_it, "evaluating all 3 frames")):
            with pytest.raises(AssertionError):  # stopped
                command(args, tmp_path / name / args[:5])
            assert (f"{root}: no splits: {said}" in capsys.readouterr().err) != splits


def test_frames_that_are_trained_and_evaluated_on_are_told(tmp_path, capsys, monkeypatch):
    root = tmp_path / "data"
    make_folder(root, train=2, val=1, sensor=fcos.load_sensor("short_range"))
    (tmp_path / "map.json").write_text(json.dumps({"person": "pedestrian", "post": "barrier", "vehicle": "car"}))
    data = f"--class-map {tmp_path}/map.json --data-root {root}"
    monkeypatch.setattr("fcos_lidar_jax.cli.train.train", Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr("fcos_lidar_jax.cli.evaluate.write_predictions", Mock(side_effect=KeyboardInterrupt))

    def said(splits, line):
        (root / "splits.json").write_text(json.dumps(splits))
        with pytest.raises(AssertionError):  # stopped
            command(line, data, "--out", tmp_path / "out")
        return capsys.readouterr().err

    a, b, c = (f"{i:03d}" for i in range(3))
    training, evaluation = "train quickstart --no-copy-paste", "evaluate --checkpoint quickstart"
    told = "of the 2 evaluation frames are also training frames"
    assert f"1 {told}" in said({"train": [a, b], "val": [b, c]}, training)
    assert "also training frames" not in said({"train": [a], "val": [b, c]}, training)
    assert f"2 {told}" in said({"all": [a, b, c]}, f"{training} --val-split all --val-samples 1:3")
    assert f"{root}: no split val: evaluating all, the only split" in said({"all": [a, b, c]}, evaluation)
    for splits, line in (({"train": [a], "val": [b, c]}, evaluation), ({"all": [a]}, f"{evaluation} --split all")):
        assert "no split val" not in said(splits, line)


def test_own_data_may_be_prepared_elsewhere_and_detections_are_those_evaluated(tmp_path, capsys):
    """As for data on a disk that cannot be written to; and the report names the frames."""
    root, index = tmp_path / "data", tmp_path / "prepared"
    make_folder(root, train=2, val=2, sensor=fcos.load_sensor("short_range"))
    (tmp_path / "map.json").write_text(json.dumps({"person": "pedestrian", "post": "barrier", "vehicle": "car"}))
    data = f"--class-map {tmp_path}/map.json --data-root {root} --index {index}"
    command("prepare", data)
    assert not (root / ".fcos_lidar").exists()
    command("train quickstart", data, "--out", tmp_path / "run", *NETWORK_OPTIONS, "--steps 2 --fade-epochs 0")
    for name in ("a", "b"):
        command("evaluate", data, "--checkpoint quickstart --out", tmp_path / name)
    for line in ("The worst sample", "The best sample"):
        assert re.search(rf"{line}.*00[23]", (tmp_path / "a" / "report.html").read_text())
    record = json.loads((tmp_path / "b" / "detections.json").read_text())
    record["frames"][0]["boxes"] = []
    (tmp_path / "given.json").write_text(json.dumps(record))
    command(
        "evaluate", data, "--checkpoint quickstart --results", tmp_path / "given.json", "--out", tmp_path / "b"
    )
    assert (tmp_path / "b" / "detections.json").read_bytes() == (tmp_path / "given.json").read_bytes()


def test_training_on_another_sensors_clouds_is_told_before_the_step_is_compiled(tmp_path, capsys, monkeypatch):
    frames = SimulatedFrames(fcos.load_sensor("nuscenes_hdl32e"), 2)
    wrong = InMemoryFrames((frames.frame(0), frames.frame(1)), fcos.load_sensor("short_range"), frames.classes)
    monkeypatch.setattr("fcos_lidar_jax.training.run.jit_step", lambda step, mesh: None)
    with pytest.raises(TypeError):  # there is no step
        train(dataclasses.replace(QUICKSTART, copy_paste=None), wrong, tmp_path / "run", steps=1)
    told, compiling = capsys.readouterr().err.splitlines()[:2]
    assert told.startswith("warning: frame 0: points hardly of sensor 'short_range'")
    assert compiling.startswith("compiling")


def test_batches_change_boxes_by_rounding_alone(tmp_path):
    detector = fcos.load_detector("quickstart")
    frames = fcos.open_frames(format="simulated", split="val", sensor=detector.sensor)
    one, two = ([p.detections for p in predict(detector, frames, indices=range(4), batch_size=n)] for n in (1, 2))
    for a, b in zip(one, two, strict=True):
        sure = a.scores > 0.3
        assert sure.any()
        np.testing.assert_allclose(b.scores[: sure.sum()], a.scores[sure], atol=1e-4)
        np.testing.assert_allclose(b.boxes[: sure.sum()], a.boxes[sure], atol=1e-4)
    assert jax.tree.structure(one[0]) == jax.tree.structure(two[0])
