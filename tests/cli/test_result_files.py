"""Boxes in the formats of others: each file is parsed here, and its boxes are those of the JSON."""

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from commands import assert_one_line_error, command
from made_kitti import AXES, P2, SHIFT, calibration_text
from scipy.spatial.transform import Rotation
from tiny_run import TINY_CONFIG, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.cli.sinks import _kitti
from fcos_lidar_jax.config import InferenceConfig
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame

CLASSES = "barrier", "truck", "traffic_cone", "trailer", "car", "pedestrian", "motorcycle", "bicycle", "bus"
CONFIG = dataclasses.replace(
    TINY_CONFIG,
    classes=(*CLASSES, "construction_vehicle"),
    inference=InferenceConfig(max_detections=60, candidates_per_level=200),
)
TIMES_US = (1_700_000_000_000_000, 1_700_000_000_100_000, 1_700_000_000_200_000)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """An untrained detector, and a drive of three clouds in KITTI's layout, with poses and calibrations."""
    home = tmp_path_factory.mktemp("home")
    variables = untrained(CONFIG, TINY)
    heads = variables["params"]["heads"]["shared"]
    classification, regression = heads["classification"], heads["regression"]
    for each in (classification["logits_kernel"], classification["logits_bias"], regression["iou_bias"]):
        each *= 0  # so that it finds boxes of two classes
    regression["size_kernel"] *= 0.05
    save_checkpoint(home / "checkpoint", Checkpoint(CONFIG, TINY, variables, 7))
    (home / "training" / "velodyne").mkdir(parents=True)
    (home / "training" / "calib").mkdir()
    listed = []
    for number, time_us in enumerate(TIMES_US):
        np.save(home / "training" / "velodyne" / f"{number:06d}.npy", make_frame(number // 2, TINY).points)
        (home / "training" / "calib" / f"{number:06d}.txt").write_text(calibration_text(AXES, np.eye(3)))
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 0.01 * number).as_matrix()
        pose[:3, 3] = 0.1 * number, 5, 1
        file = f"training/velodyne/{number:06d}.npy"
        listed.append({"file": file, "timestamp_us": time_us, "sensor_to_world": pose.tolist()})
    (home / "poses.json").write_text(json.dumps(listed))
    return home


def stream(home, out, *more):
    words = "--poses", home / "poses.json", "--checkpoint", home / "checkpoint", "--out", out
    command("stream", home / "training" / "velodyne", *words, "--min-score 0.001", *more)
    return out


@pytest.fixture(scope="module")
def lines(home):
    """The drive as lines of JSON, which have their own tests."""
    text = stream(home, home / "boxes.jsonl", "--track").read_text()
    found = [json.loads(line) for line in text.splitlines()]
    assert all(line["boxes"] for line in found)
    return found


def cuboids(frame):
    """Class-free boxes x, y, z, l, w, h, yaw, vx, vy with scores of a frame of OpenLABEL, by object."""
    found = {}
    for uid, each in frame.get("objects", {}).items():
        [shape] = each["object_data"]["cuboid"]
        assert shape["coordinate_system"] == "lidar"
        x, y, z, *turn, l, w, h = shape["val"]
        yaw, pitch, roll = Rotation.from_quat(turn).as_euler("zyx")
        assert abs(pitch) < 1e-9 > abs(roll)
        numbers = {number["name"]: number["val"] for number in shape["attributes"]["num"]}
        [velocity] = shape["attributes"]["vec"]
        found[uid] = [x, y, z, l, w, h, yaw, *velocity["val"]], numbers["score"]
    return found


@pytest.mark.slow
def test_a_drive_in_openlabel(home, lines, tmp_path):
    out = stream(home, tmp_path / "labels.json", "--track --output-format openlabel")
    [(root, content)] = json.loads(out.read_text()).items()
    assert (root, content["metadata"]["schema_version"]) == ("openlabel", "1.0.0")
    assert content["coordinate_systems"]["lidar"]["parent"] == "world"
    assert content["coordinate_systems"]["world"]["children"] == ["lidar"]
    assert content["frame_intervals"] == [{"frame_start": 0, "frame_end": 2}]
    present = {uid: [] for uid in content["objects"]}
    for number, line in enumerate(lines):
        frame = content["frames"][str(number)]
        properties = frame["frame_properties"]
        assert properties["timestamp"] == TIMES_US[number] / 1e6
        assert properties["streams"]["lidar"]["uri"] == line["file"]
        [transform] = properties["transforms"].values()
        assert (transform["src"], transform["dst"]) == ("lidar", "world")
        matrix = np.reshape(transform["transform_src_to_dst"]["matrix4x4"], (4, 4))
        np.testing.assert_array_equal(matrix, line["sensor_to_world"])
        boxes = cuboids(frame)
        assert set(boxes) == {str(box["track"]) for box in line["boxes"]}
        for box in line["boxes"]:
            uid = str(box["track"])
            found, score = boxes[uid]
            assert (score, content["objects"][uid]["type"]) == (box["score"], box["label"])
            np.testing.assert_allclose(found, box["box"], atol=1e-6)
            present[uid].append(number)
    for uid, frames in present.items():
        intervals = content["objects"][uid]["frame_intervals"]
        inside = [n for each in intervals for n in range(each["frame_start"], each["frame_end"] + 1)]
        assert inside == frames
        assert all(b["frame_start"] > a["frame_end"] + 1 for a, b in itertools.pairwise(intervals))
    assert any(len(frames) > 1 for frames in present.values())


def test_clouds_in_openlabel_have_objects_of_their_own(home, lines, tmp_path):
    clouds = [home / "training" / "velodyne" / f"{number:06d}.npy" for number in range(2)]
    how = "--min-score 0.001 --output-format openlabel --labels truck bus --out", tmp_path / "labels.json"
    command("detect", *clouds, "--checkpoint", home / "checkpoint", *how)
    content = json.loads((tmp_path / "labels.json").read_text())["openlabel"]
    assert content["coordinate_systems"] == {"lidar": {"type": "sensor_cs", "parent": "", "children": []}}
    expected = [[box for box in line["boxes"] if box["label"] in ("truck", "bus")] for line in lines[:2]]
    assert 0 < len(content["objects"]) == sum(map(len, expected)) < sum(len(line["boxes"]) for line in lines[:2])
    for number, boxes in enumerate(expected):
        assert set(content["frames"][str(number)]["frame_properties"]) == {"streams"}
        found = cuboids(content["frames"][str(number)])
        assert [score for _, score in found.values()] == [box["score"] for box in boxes]
        assert [content["objects"][uid]["type"] for uid in found] == [box["label"] for box in boxes]


def in_world(box, pose):
    """Centre, heading and velocity of a box, by a pose that turns about z."""
    pose, (x, y, z, _, _, _, yaw, vx, vy) = np.array(pose), box
    heading = pose[:3, :3] @ [np.cos(yaw), np.sin(yaw), 0]
    return (pose @ [x, y, z, 1])[:3], heading, (pose[:3, :3] @ [vx, vy, 0])[:2]


def assert_is_in_results(entries, line):
    assert len(entries) == len(line["boxes"])
    for entry, box in zip(entries, line["boxes"], strict=True):
        centre, heading, velocity = in_world(box["box"], line["sensor_to_world"])
        assert (entry["detection_name"], entry["detection_score"]) == (box["label"], box["score"])
        np.testing.assert_allclose(entry["translation"], centre, atol=1e-4)
        w, l, h = entry["size"]
        np.testing.assert_allclose([l, w, h], box["box"][3:6], rtol=1e-6)
        turn = Rotation.from_quat(entry["rotation"], scalar_first=True)
        np.testing.assert_allclose(turn.apply([1, 0, 0]), heading, atol=1e-6)
        np.testing.assert_allclose(entry["velocity"], velocity, atol=1e-5)


def test_a_drive_as_results_of_nuscenes(home, lines, tmp_path):
    out = stream(home, tmp_path / "results.json", "--output-format nuscenes")
    content = json.loads(out.read_text())
    assert content["meta"]["use_lidar"] is True
    assert list(content["results"]) == [f"{number:06d}.npy" for number in range(3)]
    for entries, line in zip(content["results"].values(), lines, strict=True):
        assert_is_in_results(entries, line)
    # A list of sweeps has the pose of its current one.
    current = json.loads((home / "poses.json").read_text())[2:]
    (home / "sweeps.json").write_text(json.dumps(current))
    words = "--checkpoint", home / "checkpoint", "--min-score 0.001 --output-format nuscenes --out"
    command("detect --sweeps", home / "sweeps.json", *words, tmp_path / "one.json")
    [(name, entries)] = json.loads((tmp_path / "one.json").read_text())["results"].items()
    assert name == "000002.npy"
    assert_is_in_results(entries, lines[2])


def test_a_second_cloud_of_a_name_is_refused(tmp_path):
    (tmp_path / "000000.txt").write_text(calibration_text())
    with _kitti(tmp_path / "out", ["car"], tmp_path) as write:
        write({"file": "a/000000.bin", "boxes": []})
        with pytest.raises(ValueError, match=r"^b/000000\.npy: got a second cloud named 000000, "):
            write({"file": "b/000000.npy", "boxes": []})


@pytest.mark.parametrize("command_line", ["stream", "detect"])
def test_result_files_of_kitti(home, lines, tmp_path, command_line, capsys, monkeypatch):
    out = named = tmp_path / "kitti"
    out.mkdir()
    (out / "000009.txt").touch()
    if command_line == "stream":
        stream(home, out, "--output-format kitti")
    else:
        monkeypatch.chdir(out)
        named = Path(".")
        where = "--checkpoint", home / "checkpoint", "--min-score 0.001 --output-format kitti --out", named
        command("detect", home / "training" / "velodyne", *where, "--calibration", home / "training" / "calib")
    told = capsys.readouterr().err
    assert f"{named}: also contains 1 .txt of other clouds, such as 000009.txt" in told
    (out / "000009.txt").unlink()
    types, written = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian"}, 0
    types |= {"bicycle": "Cyclist", "bus": "Tram"}
    assert sorted(file.name for file in out.iterdir()) == [f"{number:06d}.txt" for number in range(3)]
    for number, line in enumerate(lines):
        left = [box for box in line["boxes"] if box["label"] in types]
        for row in (out / f"{number:06d}.txt").read_text().splitlines():
            kind, *words = row.split()
            *_, h, w, l, x, y, z, turn, score = map(float, words)
            # A label stands on its bottom, and turns about the camera's downward axis.
            centre = AXES.T @ (np.array([x, y - h / 2, z]) - SHIFT)
            heading = AXES.T @ [np.cos(turn), 0, -np.sin(turn)]
            found = [*centre, l, w, h, *heading]
            box = next(box for box in left if np.float32(score) == np.float32(box["score"]))
            *numbers, yaw, _, _ = box["box"]
            assert kind == types[box["label"]]
            np.testing.assert_allclose(found, [*numbers, np.cos(yaw), np.sin(yaw), 0], rtol=1e-4, atol=1e-3)
            left.remove(box)
            written += 1
        for box in left:  # What was left out has its centre outside of the image.
            u, v, depth = P2 @ [*(AXES @ box["box"][:3] + SHIFT), 1]
            assert depth < 0.1 or not (0 < u / depth < 1241 and 0 < v / depth < 374)
    assert written > 0
    number = sum(len(line["boxes"]) for line in lines)
    left_out = f"{named}: {number - written} of {number} boxes left out: outside of the image, or of a class"
    assert left_out in told


def test_files_of_own_data_are_not_overwritten(home, tmp_path, capsys):
    call = ["detect", str(home / "training" / "velodyne"), "--checkpoint", str(home / "checkpoint"), "--out"]
    for folder in ("clouds", "boxes"):
        (tmp_path / folder).mkdir()
    for out in ("boxes/000.json", "sweeps/000.json", "splits.json", "clouds/a.npy"):
        message = "the place of a file of own data, expected another one"
        assert_one_line_error(capsys, [*call, str(tmp_path / out)], message)
        assert not (tmp_path / out).exists()


def test_detect_and_evaluate_write_recordings(home, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    checkpoint = "--checkpoint", home / "checkpoint"
    clouds = home / "training" / "velodyne"
    command("detect", clouds, *checkpoint, "--out", tmp_path / "a.json", "--rrd", tmp_path / "a.rrd")
    data = "--format simulated --samples 0:2 --no-report"
    command("evaluate", data, *checkpoint, "--out", tmp_path / "scores", "--rrd", tmp_path / "b.rrd")
    assert [(tmp_path / f"{name}.rrd").read_bytes()[:3] for name in "ab"] == [b"RRF", b"RRF"]
