"""KITTI's result files: boxes come back, their rectangles in the image, and the metric that evaluate writes."""

import json

import numpy as np
import pytest
from commands import assert_one_line_error, command
from made_kitti import AXES, MOUNTED, P2, RECTIFIED, calibration_text, label_text, write

import fcos_lidar_jax as fcos
from fcos_lidar_jax.cli import evaluate
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.frame import SelectedFrames
from fcos_lidar_jax.data.kitti import (
    CLASSES,
    IMAGE_SIZE,
    TO_NUSCENES,
    KittiFrames,
    read_calibration,
    read_objects,
    to_lidar,
)
from fcos_lidar_jax.evaluation.frames import write_detections
from fcos_lidar_jax.evaluation.kitti import describe_kitti
from fcos_lidar_jax.evaluation.kitti_results import image_boxes, to_camera, write_kitti, write_result
from fcos_lidar_jax.evaluation.records import as_records
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization import evaluation_report


def random_boxes(number, seed=0):
    """Boxes ahead, most of which the camera sees."""
    low, high = (3, -15, -3, 0.5, 0.5, 0.5, -np.pi), (60, 15, 2, 12, 3, 4, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (number, 7))


@pytest.fixture(params=[(AXES, np.eye(3)), (MOUNTED, RECTIFIED)], ids=["upright", "tilted"])
def calibration(request, tmp_path):
    write(tmp_path / "calib.txt", calibration_text(*request.param))
    return read_calibration(tmp_path / "calib.txt")


def test_boxes_return_from_a_file(tmp_path, calibration):
    boxes, scores = random_boxes(300), np.random.default_rng(1).random(300).astype(np.float32)
    types = [CLASSES[i % len(CLASSES)] for i in range(300)]
    left_out = write_result(tmp_path / "000123.txt", boxes, types, scores, calibration)
    back_types, fields = read_objects(tmp_path / "000123.txt")
    back, back_scores = to_lidar(fields[:, 7:14], calibration["velo_to_rect"]), fields[:, 14]
    seen = image_boxes(to_camera(boxes, calibration["velo_to_rect"]), calibration["P2"], IMAGE_SIZE)[1]
    assert 0 < left_out == (~seen).sum() < 100
    np.testing.assert_allclose(back[:, :6], boxes[seen, :6], atol=1e-4)
    turn = (back[:, 6] - boxes[seen, 6] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn).max() < 1e-4
    assert back_types == [name for name, there in zip(types, seen, strict=True) if there]
    np.testing.assert_array_equal(back_scores.astype(np.float32), scores[seen])


def test_rectangles_in_the_image_hold_the_surface_and_no_more():
    """Points on all faces, those before the camera, projected one by one; some boxes reach behind the camera."""
    rng = np.random.default_rng(3)
    boxes = rng.uniform((1, 1, 1, -8, 0, -3, -3.1), (3, 3, 9, 8, 3, 30, 3.1), (150, 7))
    found, visible = image_boxes(boxes, P2, IMAGE_SIZE)
    grid = np.linspace(-1, 1, 161)
    edges = [np.roll([a, b, c], k) for k in range(3) for a in grid for b in (-1, 1) for c in (-1, 1)]
    last, crossing = np.array(IMAGE_SIZE) - 1, 0
    for (h, w, l, x, y, z, turn), rectangle, seen in zip(boxes, found, visible, strict=True):
        a, b, up = (np.array(edges) * (l / 2, w / 2, h / 2)).T
        points = np.stack(
            [x + np.cos(turn) * a + np.sin(turn) * b, y - h / 2 + up, z + np.cos(turn) * b - np.sin(turn) * a]
        )
        u, v, depth = P2[:, :3] @ points + P2[:, 3:]
        ahead = depth > 0.1
        crossing += 0 < ahead.sum() < len(ahead)
        if not ahead.any():
            assert not seen
            continue
        pixels = np.stack([u, v])[:, ahead] / depth[ahead]
        low, high = np.clip(pixels.min(axis=1), 0, last), np.clip(pixels.max(axis=1), 0, last)
        assert (rectangle[:2] <= low + 1e-9).all()
        assert (rectangle[2:] >= high - 1e-9).all()
        if (depth > 0.1).all():
            np.testing.assert_allclose(rectangle, [*low, *high], atol=1e-9)
        assert seen or not (high > low).all()
    assert crossing > 10


def test_what_no_object_can_be_is_left_out(tmp_path, calibration):
    boxes = np.tile([20, 0, -1, 4, 1.6, 1.5, 0.0], (6, 1))
    boxes[1, 0], boxes[2, 3], boxes[3, 5], boxes[4, 0], boxes[5, 6] = -20, 600, 1e-7, 20_000, np.nan
    assert write_result(tmp_path / "a.txt", boxes, ["Car"] * 6, np.ones(6), calibration) == 5
    assert len(read_objects(tmp_path / "a.txt")[0]) == 1


CARS = [(x, y, -0.9, 4.0, 1.7, 1.5, 0.1) for x in (10.0, 15.0, 20.0) for y in (-4.0, 0.0, 4.0)]
"""Higher than 40 pixels. Six frames of them are more than the 41 positions."""


def in_the_image(text):
    """A label with its alpha and its box in the image."""
    words = text.split()
    camera = np.array([[float(word) for word in words[8:15]]])
    words[3] = str(camera[0, 6] - np.arctan2(camera[0, 3], camera[0, 5]))
    words[4:8] = [str(pixel) for pixel in image_boxes(camera, P2, IMAGE_SIZE)[0][0].tolist()]
    return " ".join(words) + "\n"


@pytest.fixture
def root(tmp_path):
    """Six frames of cars, with a pedestrian and an area without labels."""
    root = tmp_path / "kitti"
    walker = label_text((11.0, -2.0, -0.8, 0.6, 0.7, 1.8, -2.0), "Pedestrian")
    labels = "".join(in_the_image(text) for text in (*map(label_text, CARS), walker))
    labels += "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
    for i in range(6):
        write(root / "training" / "calib" / f"00000{i}.txt", calibration_text())
        write(root / "training" / "label_2" / f"00000{i}.txt", labels)
        (root / "training" / "velodyne").mkdir(exist_ok=True)
        np.array([[15, 0, -1, 0.2]], np.float32).tofile(root / "training" / "velodyne" / f"00000{i}.bin")
    return root


def perfect(frames):
    """Detections that are the truth, with a row of padding."""
    for index in range(len(frames)):
        frame = frames.truth(index)
        number = len(frame.boxes) + 1
        boxes = np.nan_to_num(np.concatenate([frame.boxes, np.ones((1, 9))]))
        labels = np.concatenate([frame.labels, [0]]).astype(np.int32)
        yield Detections(boxes, np.full(number, 0.7), labels, np.arange(number) < number - 1, np.int32(0))


def test_the_metric_of_what_was_written(root, tmp_path):
    frames, out = MappedFrames(KittiFrames(root), ("Truck", "Car", "Pedestrian")), tmp_path / "out"
    write(out / "results_kitti" / "000009.txt", "of an older evaluation")
    metrics = write_kitti(out, perfect(frames), frames)
    assert metrics is not None
    assert json.loads((out / "metrics_kitti.json").read_text()) == metrics
    car = metrics["classes"]["Car"]
    assert (car["num_truth"]["hard"], car["bev"]["easy"], car["3d"]["hard"]) == (54, 100.0, 100.0)
    assert (car["image"]["moderate"], car["aos"]["moderate"]) == pytest.approx((100.0, 100.0))
    assert (metrics["num_frames"], metrics["left_out"]) == (6, ["Truck", "Cyclist"])
    assert sorted(f.name for f in (out / "results_kitti").iterdir()) == [f"00000{i}.txt" for i in range(6)]
    assert "left out, not in both the detector and KITTI's metric: Truck, Cyclist" in describe_kitti(metrics)
    # Some of the frames; then frames of other data, which leave no numbers of these.
    some = SelectedFrames(frames, (1,))
    assert write_kitti(out, perfect(some), some)["num_frames"] == 1
    assert [f.name for f in (out / "results_kitti").iterdir()] == ["000001.txt"]
    assert write_kitti(out, [], SimulatedFrames(TINY, 2)) is None
    assert not (out / "metrics_kitti.json").exists()


def test_a_class_map_is_undone_and_names_match_in_lower_case(root, tmp_path):
    """A class of several types stands for the one of the metric."""
    names = {"Van": "vehicle", "Car": "vehicle", "Cyclist": None}
    frames = MappedFrames(KittiFrames(root), ("cyclist", "vehicle", "pedestrian", "Misc", "Pedestrian"), names)
    metrics = write_kitti(tmp_path, perfect(frames), frames)
    assert metrics is not None
    assert (list(metrics["classes"]), metrics["left_out"]) == (
        ["Car", "Pedestrian"],
        ["cyclist", "Misc", "Cyclist"],
    )
    types = [line.split()[0] for line in (tmp_path / "results_kitti" / "000001.txt").read_text().splitlines()]
    assert types == ["Car"] * 9 + ["Pedestrian"]


@pytest.mark.slow
def test_evaluate_writes_and_prints_it(root, tmp_path, capsys):
    frames = MappedFrames(KittiFrames(root), fcos.load_detector("quickstart").classes, TO_NUSCENES)
    records = [json.dumps(as_records(found, frames.classes)).encode() for found in perfect(frames)]
    named = [(frames.name(i), record) for i, record in enumerate(records)]
    write_detections(tmp_path / "given.json", named, frames.classes)
    data = f"--data-root {root} --class-map nuscenes --checkpoint quickstart"
    command("evaluate", data, f"--no-report --results {tmp_path}/given.json --out {tmp_path}/out")
    metrics = json.loads((tmp_path / "out" / "metrics_kitti.json").read_text())
    assert metrics["classes"]["Car"]["3d"] == {"easy": 100.0, "moderate": 100.0, "hard": 100.0}
    assert list(metrics["classes"]) == ["Car", "Pedestrian", "Cyclist"]
    ((_, header, rows),) = evaluation_report._kitti_table(tmp_path / "out" / "metrics_kitti.json")
    assert header == ("class", "easy", "moderate", "hard", "objects: easy / moderate / hard")
    assert rows[1] == ("Car, 3d", 100.0, 100.0, 100.0, "54 / 54 / 54")
    assert [name for name, *_ in rows[2:4]] == ["Car, image", "Car, aos"]
    assert evaluation_report._kitti_table(tmp_path / "none.json") == []
    printed = capsys.readouterr().out
    assert "KITTI AP_R40 on 6 frames" in printed
    assert "mAP by centre distance" in printed
    # The result files alone give the same numbers, from the folder that the development kit reads, too.
    (tmp_path / "out" / "results_kitti").rename(tmp_path / "data")
    (tmp_path / "out" / "results_kitti").mkdir()
    (tmp_path / "data").rename(tmp_path / "out" / "results_kitti" / "data")
    command(f"evaluate --data-root {root} --results {tmp_path}/out/results_kitti --out {tmp_path}/again")
    again = json.loads((tmp_path / "again" / "metrics_kitti.json").read_text())
    assert {**again, "left_out": metrics["left_out"]} == metrics
    assert capsys.readouterr().out.startswith(describe_kitti(again))
    assert {file.name for file in (tmp_path / "again").iterdir()} == {"metrics_kitti.json", ".lock"}


@pytest.mark.parametrize(
    ("kind", "message"),
    [("label_2", "000005.txt: line 1: got 3 values, expected 15"), ("calib", "000005.txt: P2: missing, ")],
)
def test_damaged_files_are_named_before_anything_is_detected(root, tmp_path, monkeypatch, capsys, kind, message):
    monkeypatch.setattr(evaluate, "run_detector", lambda *_, **__: pytest.fail("detects"))
    write(root / "training" / kind / "000005.txt", "Car 0 0\n")
    line = f"evaluate --data-root {root} --class-map nuscenes --checkpoint quickstart --out {tmp_path}/out"
    assert_one_line_error(capsys, line.split(), message)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--results found --class-map nuscenes", "--class-map: got nuscenes, expected none with a folder"),
        ("--results found --sensor tiny", "--sensor: got tiny, expected none with a folder"),
        ("--results found --full-turn", "--full-turn: got True, expected none with a folder"),
        ("--results found", "found: sample 000001: missing; sample 9: not expected: .* 2 samples of split 'val'$"),
        (
            "--results found/9.txt",
            "--results: found/9.txt: expected --checkpoint too, .*, or a folder of KITTI's",
        ),
    ],
)
def test_a_folder_of_results_that_does_not_fit_is_refused(root, tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    write(root / "ImageSets" / "val.txt", "000000\n000001\n")
    for name in ("000000", "9"):
        write(tmp_path / "found" / f"{name}.txt", "")
    assert_one_line_error(capsys, f"evaluate --data-root {root} --out out {options}".split(), message)
    assert not (tmp_path / "out").exists()
