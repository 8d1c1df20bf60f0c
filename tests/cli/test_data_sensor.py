"""Clouds of other sensors: the same boxes from every command and from Python, whose units and axes are told."""

import dataclasses
import json
import math
import shutil
import warnings

import numpy as np
import pytest
from commands import command, page_content
from made_argoverse2 import make_log
from made_folder import make_folder
from made_kitti import make_kitti, write_raw_drive
from tiny_run import CONFIG, save_untrained

import fcos_lidar_jax as fcos
from fcos_lidar_jax import progress
from fcos_lidar_jax.checkpoints import load_checkpoint, save_checkpoint
from fcos_lidar_jax.cli import options
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.data.kitti import TO_NUSCENES
from fcos_lidar_jax.evaluation.records import cloud_record
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E, sensor_to_json

SMALL = "--checkpoint small --out"


@pytest.fixture(autouse=True, scope="module")
def _small(tmp_path_factory):
    """An untrained detector of nuScenes' sensor, called ``small`` in all these tests."""
    folder = tmp_path_factory.mktemp("detector")
    sensor = dataclasses.replace(NUSCENES_HDL32E, num_columns=128)
    inference = InferenceConfig(min_probability=0.5, max_detections=300, candidates_per_level=100)
    config = dataclasses.replace(CONFIG, max_points=20_000, inference=inference)
    save_untrained(folder / "small", config, sensor)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    """Two frames of KITTI, a copy of the first cloud elsewhere, a raw drive of it, and a class map."""
    root = make_kitti(
        tmp_path_factory.mktemp("data") / "kitti",
        train=1,
        val=1,
        sensor=dataclasses.replace(KITTI_HDL64E, num_columns=256),
    )
    (root / "map.json").write_text(json.dumps(TO_NUSCENES))
    (root / "elsewhere").mkdir()
    cloud = root / "training" / "velodyne" / "000000.bin"
    shutil.copy(cloud, root / "elsewhere" / "cloud.bin")
    write_raw_drive(root / "day", [np.fromfile(cloud, np.float32)], ["49 8.4 110 0 0 0"])
    return root


def detect(out, *words):
    """Boxes of the first file."""
    command("detect", *words, SMALL, out)
    return json.loads(out.read_text())["files"][0]["boxes"]


def stream(out, *words):
    """Boxes of the first sweep."""
    command("stream", *words, SMALL, out)
    return json.loads(out.read_text().splitlines()[0])["boxes"]


def as_nuscenes(points, origin=(0, 0, 0)):
    """Points [n, 4] with x ahead, of a sensor at a place on the ego vehicle, with y ahead of the sensor."""
    x, y, z = (points[:, :3] - np.array(origin, np.float32)).T
    return np.column_stack([-y, x, z, points[:, 3]])


def assert_turned_back(boxes, expected, origin=(0, 0, 0)):
    """Assert that boxes with x ahead are those of :func:`as_nuscenes`."""
    assert len(boxes) == len(expected) > 20
    for one, other in zip(boxes, expected, strict=True):
        assert one["label"] == other["label"]
        assert one["score"] == pytest.approx(other["score"], abs=1e-5)
        x, y, z, *size, yaw, vx, vy = other["box"]
        place = np.array([y, -x, z]) + origin
        np.testing.assert_allclose(one["box"][:6], [*place, *size], atol=1e-4)
        np.testing.assert_allclose(np.exp(1j * one["box"][6]), np.exp(1j * (yaw - np.pi / 2)), atol=1e-4)
        np.testing.assert_allclose(one["box"][7:], [vy, -vx], atol=1e-4)


@pytest.mark.slow
def test_a_kitti_cloud_gives_the_same_boxes_in_every_way(kitti, tmp_path, capsys):
    folder, drive = kitti / "training" / "velodyne", kitti / "day" / "drive"
    boxes = detect(tmp_path / "boxes.json", folder, "--full-turn --page", tmp_path / "page.html")
    assert page_content(tmp_path / "page.html")["forward_rad"] == KITTI_HDL64E.forward_rad
    told = capsys.readouterr().err
    assert told.count("recorded by kitti_hdl64e") == told.count("intensities times 255") == 1  # of two files
    assert told.count("clouds rotated by 90 degrees") == 1
    assert "no intensity is above 1" not in told
    assert "outside the camera image" not in told
    cropped = detect(tmp_path / "cropped.json", folder)
    told = capsys.readouterr().err
    assert told.count("points outside the camera image are left out; --full-turn keeps them") == 1  # of two files

    raw = np.fromfile(folder / "000000.bin", np.float32).reshape(-1, 4)
    np.save(tmp_path / "by_hand.npy", as_nuscenes(raw * np.float32([1, 1, 1, 255])))
    assert_turned_back(boxes, detect(tmp_path / "by_hand.json", tmp_path / "by_hand.npy"))

    data = f"--data-root {kitti} --format kitti --split train --class-map {kitti}/map.json --no-report"
    for more, expected in (("", cropped), ("--full-turn", boxes)):
        progress._told.clear()  # commands of one test print notes again
        command("evaluate", data, more, SMALL, tmp_path / f"scores{more}")
        told = capsys.readouterr().err
        assert (f"{kitti}: points outside the camera image are left" in told) == (not more)
        assert ("detections outside the camera image, where KITTI has no labels" in told) == bool(more)
        [evaluated] = json.loads((tmp_path / f"scores{more}" / "detections.json").read_text())["frames"]
        assert evaluated["boxes"] == expected
    assert 0 < len(cropped) < len(boxes)
    copy = kitti / "elsewhere" / "cloud.bin"
    assert detect(tmp_path / "a.json", copy, "--data-sensor kitti_hdl64e") == boxes
    assert stream(tmp_path / "a.jsonl", copy, "--yaw-deg 90 --intensity-scale 255") == boxes

    detector = fcos.load_detector("small")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "points do not fit sensor")  # it has 64 beams
        capsys.readouterr()
        by_path, again = (detector(folder / "000000.bin", full_turn=True) for _ in range(2))
        assert capsys.readouterr().err.count("recorded by kitti_hdl64e") <= 1  # not for every file
        by_sensor, moved = detector(raw, sensor="kitti_hdl64e"), detector(kitti / "elsewhere" / "cloud.bin")
        frames = fcos.open_frames(kitti, reading=detector.config.reading, full_turn=True)
        of_frame = detector(frames.frame(0).points, sensor=frames.sensor)
        assert "they seem to be scaled already" in capsys.readouterr().err
        assert detector(folder / "000000.bin").to_dict()["boxes"] == cropped
    for found in (by_path, again, by_sensor, of_frame):
        assert found.to_dict()["boxes"] == boxes
        assert found.points[:, 3].max() > 1
        np.testing.assert_allclose(
            found.points[:, :4], raw * [1, 1, 1, 255], atol=1e-4
        )  # in the frame of the file
    assert moved.to_dict()["boxes"] != boxes

    for source in (drive, drive / "velodyne_points" / "data"):
        capsys.readouterr()
        assert stream(tmp_path / "boxes.jsonl", source, "--page", tmp_path / "drive.html") == boxes
        assert page_content(tmp_path / "drive.html")["forward_rad"] == KITTI_HDL64E.forward_rad
        told = capsys.readouterr().err
        assert told.count("clouds rotated by 90 degrees") == 1


def test_argoverse2_is_turned_and_shifted(tmp_path):
    log = make_log(tmp_path / "log", 0, sweeps=1, sensor=dataclasses.replace(ARGOVERSE2, num_columns=256))
    boxes = detect(tmp_path / "boxes.json", log / "sensors" / "lidar")
    assert stream(tmp_path / "boxes.jsonl", log) == boxes
    points = fcos.open_frames(log).frame(0).points[:, :4]
    np.save(tmp_path / "by_hand.npy", as_nuscenes(points, (1.35, 0, 1.64)))
    by_hand = detect(tmp_path / "by_hand.json", tmp_path / "by_hand.npy")
    assert_turned_back(boxes, by_hand, (1.35, 0, 1.64))


@pytest.mark.slow
def test_nuscenes_data_are_brought_to_a_detector_of_another_mount(tmp_path, capsys):
    """A detector with x ahead and the LiDAR above the rear axle, as in Argoverse 2."""
    rows = dataclasses.replace(NUSCENES_HDL32E, num_columns=128)
    (tmp_path / "rows.json").write_text(json.dumps(sensor_to_json(rows)))
    command(f"synthesize --out {tmp_path}/data --scenes 1 --keyframes 1 --sensor {tmp_path}/rows.json")
    mount = {"forward_rad": 0.0, "origin_m": (1.35, 0.0, 1.64), "limit_z_m": (-3.36, 4.64)}
    sensor, trained = dataclasses.replace(rows, **mount, intensity_scale=255.0), load_checkpoint("small")
    save_checkpoint(tmp_path / "moved", dataclasses.replace(trained, sensor=sensor))
    [cloud] = (tmp_path / "data" / "samples" / "LIDAR_TOP").iterdir()
    x, y, z, intensity, _ = np.fromfile(cloud, np.float32).reshape(-1, 5).T
    np.save(tmp_path / "by_hand.npy", np.column_stack([y + 1.35, -x, z + 1.64, intensity / 255]))

    def told(command_line, out):
        capsys.readouterr()
        command(command_line, "--checkpoint", tmp_path / "moved", "--out", tmp_path / out)
        return capsys.readouterr().err

    told(f"detect {tmp_path}/by_hand.npy", "by_hand.json")
    [by_hand] = json.loads((tmp_path / "by_hand.json").read_text())["files"]
    [scene] = json.loads(next((tmp_path / "data").glob("*/scene.json")).read_text())
    data = f"--data-root {tmp_path}/data"
    line = "clouds rotated by -90 degrees and shifted by (1.35, 0.00, 1.64) m, and boxes transformed back"
    assert line in told(f"detect {cloud}", "file.json")
    assert line in told(f"stream {data} --scene {scene['name']} --keyframes", "scene.jsonl")
    assert line in told(f"evaluate {data} --split train --no-report", "scores")
    detector = fcos.load_detector(tmp_path / "moved")
    how = {"sensor": detector.sensor, "reading": detector.config.reading}
    [predicted] = fcos.predict(detector, fcos.open_frames(tmp_path / "data", **how))
    for found in (
        json.loads((tmp_path / "file.json").read_text())["files"][0]["boxes"],
        json.loads((tmp_path / "scene.jsonl").read_text())["boxes"],
        cloud_record(predicted.detections, predicted.cloud, detector.classes)["boxes"],
    ):
        assert_turned_back(by_hand["boxes"], found, (1.35, 0, 1.64))


def test_the_sensor_of_own_data_is_used_for_their_files(tmp_path, capsys):
    sensor = dataclasses.replace(NUSCENES_HDL32E, num_columns=128)
    data = make_folder(tmp_path / "data", sensor=sensor, train=0, val=1)
    described = {**sensor_to_json(sensor), "name": "mine", "forward_rad": 0.0, "intensity_scale": 4.0}
    (data / "sensor.json").write_text(json.dumps(described))
    (data / "older").mkdir()
    copy, older = (shutil.copy(data / "clouds" / "000.npy", tmp_path / name) for name in ("a.npy", "data/older"))
    out = tmp_path / "boxes.json"
    expected = detect(out, copy, "--yaw-deg 90 --intensity-scale 4")
    assert expected != detect(out, copy)
    capsys.readouterr()
    assert detect(out, data / "clouds") == detect(out, older) == expected
    told = "recorded by mine, as its sensor.json says; override with --data-sensor: intensities times 4"
    assert f"{data}/clouds: {told}" in capsys.readouterr().err
    assert stream(out, data / "clouds") == expected
    (tmp_path / "map.json").write_text(json.dumps({"person": "pedestrian", "post": "barrier", "vehicle": "car"}))
    ahead = detect(out, copy, "--yaw-deg 0 --intensity-scale 4")
    for more, boxes in (("", expected), ("--yaw-deg 0", ahead)):
        scores = tmp_path / f"scores{more}"
        command(f"evaluate --data-root {data} --class-map {tmp_path}/map.json --no-report", more, SMALL, scores)
        [evaluated] = json.loads((scores / "detections.json").read_text())["frames"]
        assert evaluated["boxes"] == boxes
    assert fcos.load_detector("small")(data / "clouds" / "000.npy").to_dict()["boxes"] == expected


@pytest.mark.parametrize(
    ("degrees", "note"),
    [
        (1.57, "note: --yaw-deg 1.57 is in degrees; are 90 meant?\n"),
        (90.0, ""),
        (11.0, ""),  # nearly 3.5 pi
        (None, ""),
    ],
)
def test_an_angle_in_radians_is_told(degrees, note, capsys):
    assert options.radians(degrees) == (None if degrees is None else math.radians(degrees))
    assert capsys.readouterr().err == note
