"""Every format from the command line: prepare, train, evaluate, detect; and the same boxes in every way."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from made_argoverse2 import make_argoverse2
from made_folder import CLASSES, make_folder
from made_kitti import make_kitti
from tiny_run import NETWORK_OPTIONS, SENSOR

import fcos_lidar_jax as fcos
from fcos_lidar_jax import cli
from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, sensor_to_json
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.trainer import predict

STEPS = 20


def command(*args: object) -> None:
    assert cli.main([str(arg) for arg in args]) == 0


def nuscenes(root: Path) -> tuple[list[object], list[object], Path, tuple[str, ...]]:
    sensor = root / "sensor.json"
    root.mkdir()
    sensor.write_text(json.dumps(sensor_to_json(SENSOR)))
    command("synthesize", "--out", root / "data", "--scenes", 2, "--keyframes", 3, "--sensor", sensor)
    cloud = next((root / "data" / "samples" / "LIDAR_TOP").iterdir())
    preset = ["quickstart", "--sensor", sensor, "--max-points", 1024]
    return ["--data-root", root / "data"], preset, cloud, NUSCENES_CLASSES


def kitti(root: Path) -> tuple[list[object], list[object], Path, tuple[str, ...]]:
    coarse = dataclasses.replace(KITTI_HDL64E, num_columns=256)
    make_kitti(root, sensor=coarse)
    (root / "sensor.json").write_text(json.dumps(sensor_to_json(coarse)))
    preset = ["kitti", "--sensor", root / "sensor.json", "--max-points", 16384]
    return ["--data-root", root], preset, root / "training" / "velodyne" / "000000.bin", KITTI_CLASSES


def argoverse2(root: Path) -> tuple[list[object], list[object], Path, tuple[str, ...]]:
    coarse = dataclasses.replace(ARGOVERSE2, num_columns=64)
    make_argoverse2(root, sensor=coarse)
    (root / "sensor.json").write_text(json.dumps(sensor_to_json(coarse)))
    cloud = next(root.rglob("sensors/lidar/*.feather"))
    preset = ["argoverse2", "--sensor", root / "sensor.json", "--max-points", 8192]
    return ["--data-root", root], preset, cloud, ARGOVERSE2_CLASSES


def folder(root: Path) -> tuple[list[object], list[object], Path, tuple[str, ...]]:
    make_folder(root, sensor=SENSOR)
    return (
        ["--data-root", root],
        ["quickstart", "--classes", *CLASSES, "--copy-paste.targets", 2, 2, 2],
        root / "clouds" / "000.npy",
        CLASSES,
    )


def simulated(root: Path) -> tuple[list[object], list[object], Path, tuple[str, ...]]:
    root.mkdir()
    (root / "sensor.json").write_text(json.dumps(sensor_to_json(SENSOR)))
    frames = fcos.open_frames(format="simulated", split="val", sensor=SENSOR)
    np.save(root / "cloud.npy", frames.frame(0).points)
    preset = ["quickstart", "--no-copy-paste", "--sensor", root / "sensor.json", "--max-points", 1024]
    return ["--format", "simulated"], preset, root / "cloud.npy", NUSCENES_CLASSES


@pytest.mark.parametrize(
    "make",
    [
        nuscenes,
        folder,
        *(pytest.param(make, marks=pytest.mark.slow) for make in (argoverse2, kitti, simulated)),
    ],
)
def test_prepares_trains_evaluates_and_detects(make, tmp_path, capsys):
    data, preset, cloud, classes = make(tmp_path / "data")
    run, scores, boxes = tmp_path / "run", tmp_path / "scores", tmp_path / "boxes.json"
    some = ["--samples", "0:4", "--val-samples", "0:2"] if make is simulated else []
    if make is not simulated:
        command("prepare", *data)
    often = ["--steps", STEPS, "--save-every", STEPS, "--evaluate-every", STEPS]
    command("train", *preset, *data, "--out", run, *NETWORK_OPTIONS, *often, *some)
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (said["steps"], Path(said["checkpoint"]).name) == (STEPS, f"{STEPS:08d}")
    command("evaluate", *data, "--checkpoint", run, "--out", scores, *(["--samples", "0:2"] if some else []))
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
    command("detect", root / "clouds", "--checkpoint", "quickstart", "--out", tmp_path / "boxes.json")
    by_command = json.loads((tmp_path / "boxes.json").read_text())["files"]
    assert by_command[0]["num_truncated"] > 0
    command(
        *("evaluate", "--data-root", root, "--class-map", tmp_path / "map.json", "--split", "train"),
        *("--checkpoint", "quickstart", "--out", tmp_path / "scores", "--no-report"),
    )
    evaluated = json.loads((tmp_path / "scores" / "detections.json").read_text())["frames"]
    detector = fcos.load_detector("quickstart")
    for i, frame in enumerate(evaluated):
        assert frame["boxes"] == by_command[i]["boxes"]
        found = detector(np.load(root / "clouds" / f"{frame['name']}.npy"))
        count = int(found.valid.sum())
        assert count == len(frame["boxes"]) > 0
        assert [box["box"] for box in frame["boxes"]] == found.boxes[:count].tolist()
        assert [box["score"] for box in frame["boxes"]] == found.scores[:count].tolist()


def test_a_cloud_of_another_sensor_is_told_in_one_line(tmp_path, capsys):
    cloud = make_frame(0, fcos.load_sensor("nuscenes_hdl32e")).points
    np.save(tmp_path / "cloud.npy", cloud)
    command("detect", tmp_path / "cloud.npy", "--checkpoint", "quickstart", "--out", tmp_path / "boxes.json")
    told = [line for line in capsys.readouterr().err.splitlines() if "hardly of" in line]
    assert len(told) == 1
    assert told[0].startswith("warning: ")


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
