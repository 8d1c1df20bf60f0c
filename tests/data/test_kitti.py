"""KITTI: boxes in the Velodyne's frame against an independent transformation; one-line errors."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from made_kitti import AXES, MOUNTED, P2, RECTIFIED, SHIFT, calibration_text, label_text, write
from refusal import refused
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.config import WHOLE_SWEEP, CloudReading
from fcos_lidar_jax.data.clouds import CloudFiles
from fcos_lidar_jax.data.kitti import (
    CLASSES,
    KittiFrames,
    in_camera,
    in_image,
    read_calibration,
    read_labels,
    to_lidar,
)
from fcos_lidar_jax.sensors import KITTI_HDL64E, TINY

UPRIGHT = Rotation.from_euler("y", 0.8, degrees=True).as_matrix()  # about the camera's vertical
CAR = (15.0, 2.0, -0.9, 4.0, 1.7, 1.5, 0.4)
CLOUD = [[15, 2, -1, 0.2], [14, 1.6, -0.8, 1], [9, -1, -0.5, 0], [-15, 2, -1, 0.2], [5, 9, 0, 0.1], [0.5, 0, 0, 1]]


@pytest.fixture
def root(tmp_path):
    """Two frames; 000007 has a car, a pedestrian, something else and an area that is no object, 000003 nothing."""
    training = tmp_path / "training"
    ignored = "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\nMisc 0 0 0 1 2 3 4 1 1 1 1 1 9 0\n"
    walker = label_text((9.0, -1.0, -0.8, 0.6, 0.7, 1.8, -2.0), "Pedestrian")
    for name, labels in (("000007", label_text(CAR) + "\n" + ignored + walker), ("000003", "")):
        write(training / "calib" / f"{name}.txt", calibration_text())
        write(training / "label_2" / f"{name}.txt", labels)
        (training / "velodyne").mkdir(exist_ok=True)
        np.array(CLOUD, np.float32).tofile(training / "velodyne" / f"{name}.bin")
    return tmp_path


def test_a_point_file_is_cropped_like_its_frame_unless_it_lies_elsewhere(root, capsys, monkeypatch):
    points = np.array(CLOUD, np.float32)
    file = root / "training" / "velodyne" / "000007.bin"
    cropped = in_camera(file, points)
    np.testing.assert_array_equal(cropped[:, :3], KittiFrames(root).frame(1).points[:, :3])
    assert 0 < len(cropped) < len(points)
    for how, expected in (({}, cropped), ({"full_turn": True}, points)):
        read = CloudFiles((file,), KITTI_HDL64E, **how).frame(0).points
        np.testing.assert_array_equal(read[:, :3], expected[:, :3])
    assert capsys.readouterr().err.count("points outside the camera image are left out") == 1
    monkeypatch.chdir(file.parent)
    np.testing.assert_array_equal(in_camera(Path(file.name), points), cropped)
    calibration = root / "training" / "calib" / "000003.txt"
    calibration.unlink()
    with pytest.raises(ValueError, match=r"calib/000003\.txt: no such file, expected the calibration of .*000003"):
        in_camera(file.with_name("000003.bin"), points)
    calibration.parent.rename(root / "elsewhere")
    for other in (file.with_name("000003.bin"), root / "000007.bin"):
        np.testing.assert_array_equal(in_camera(other, points), points)


def test_the_fingerprints_of_point_files_depend_on_all_that_their_points_do(root):
    files = tuple(sorted((root / "training" / "velodyne").iterdir()))
    clouds = CloudFiles(files, KITTI_HDL64E)
    changes = (
        {},
        {"sensor": dataclasses.replace(KITTI_HDL64E, intensity_scale=1.0)},
        {"sensor": dataclasses.replace(KITTI_HDL64E, origin_m=(0.0, 0.0, 1.7))},
        {"reading": CloudReading(remove_close="all")},
        {"columns": 5},
        {"full_turn": True},
    )
    prints = {dataclasses.replace(clouds, **change).fingerprint() for change in changes}
    assert len(prints) == len(changes)
    before = [clouds.clouds_fingerprint([index]) for index in range(2)]
    (root / "training" / "calib" / "000007.txt").write_text(calibration_text() + "\n")
    after = [clouds.clouds_fingerprint([index]) for index in range(2)]
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False]


def test_frames_are_sorted_by_name_and_have_points_boxes_labels_and_counts(root):
    frames = KittiFrames(root)
    assert (len(frames), frames.names) == (2, ("000003", "000007"))
    frame = frames.frame(1)
    assert [CLASSES[i] for i in frame.labels] == ["Car", "Misc", "Pedestrian"]
    assert frame.num_points.tolist() == [2, 1, 1]
    np.testing.assert_array_equal(frames.labels(1), frame.labels)
    np.testing.assert_allclose(frame.boxes[0, :7], CAR, atol=1e-3)
    assert np.isnan(frame.boxes[:, 7:]).all()
    empty = frames.frame(0)
    assert (empty.boxes.shape, empty.labels.tolist(), empty.num_points.tolist()) == ((0, 9), [], [])


def test_points_outside_the_image_are_dropped(root):
    """Points behind, beside and on the car are dropped; intensities reach 255."""
    seen = np.array([[15, 2, -1, 51, 0], [14, 1.6, -0.8, 255, 0], [9, -1, -0.5, 0, 0]], np.float32)
    np.testing.assert_allclose(KittiFrames(root).frame(1).points, seen)
    readings = CloudReading(1, "all"), WHOLE_SWEEP
    whole = [KittiFrames(root, full_turn=True, reading=reading).frame(1) for reading in readings]
    assert [(len(frame.points), frame.num_close) for frame in whole] == [(5, 1), (6, 0)]
    # The pedestrian lies to the right of the car, and a narrower image has only the car.
    calibration = read_calibration(root / "training" / "calib" / "000007.txt")
    to_image = calibration["P2"] @ calibration["velo_to_rect"]
    assert in_image(np.array(CLOUD), to_image, (600, 375)).sum() == 2


def test_the_border_of_the_image_follows_from_the_projection(root):
    """Of points at chosen pixels and depths, only those inside the image are kept."""
    pixels = np.array([(1, 1), (1240, 373), (600, 180), (-2, 180), (1244, 180), (600, -2), (600, 377)], np.float64)
    depths = np.repeat([3.0, 40.0, -10.0], len(pixels))[:, None]
    seen = np.hstack([np.tile(pixels, (3, 1)) * depths, depths]) - P2[:, 3]
    velo = (seen @ np.linalg.inv(P2[:, :3]).T @ RECTIFIED - SHIFT) @ MOUNTED  # transposed rotations
    np.column_stack([velo, np.zeros(len(velo))]).astype(np.float32).tofile(root / "training/velodyne/000003.bin")
    points = KittiFrames(root, reading=WHOLE_SWEEP).frame(0).points
    kept = [0, 1, 2, 7, 8, 9]
    np.testing.assert_allclose(points[:, :3], velo[kept].astype(np.float32))


def through_files(tmp_path, number, *calibration):
    """Random boxes, the camera boxes read from their label file, and these transformed back."""
    low, high = (3, -25, -3, 0.5, 0.5, 0.5, -np.pi), (60, 25, 2, 12, 3, 4, np.pi)
    boxes = np.random.default_rng(0).uniform(low, high, (number, 7))
    write(tmp_path / "calib.txt", calibration_text(*calibration))
    write(tmp_path / "label.txt", "".join(label_text(box, "Car", *calibration) for box in boxes))
    camera, _ = read_labels(tmp_path / "label.txt")
    return boxes, camera, to_lidar(camera, read_calibration(tmp_path / "calib.txt")["velo_to_rect"])


def tilt_of(mounted, rectified):
    """Angle between the verticals of camera and Velodyne."""
    up = (rectified @ mounted)[:, 2]
    return np.arcsin(np.hypot(up[0], up[2]))


CALIBRATIONS = {"upright": (AXES, UPRIGHT), "tilted": (MOUNTED, RECTIFIED)}


@pytest.mark.parametrize("calibration", CALIBRATIONS)
def test_boxes_survive_the_way_through_a_label_file(tmp_path, calibration):
    """Almost exactly if camera and Velodyne share the vertical; otherwise the yaw loses the tilt."""
    tilt = tilt_of(*CALIBRATIONS[calibration])
    assert tilt < 1e-12 if calibration == "upright" else np.radians(0.3) < tilt < np.radians(1.5)
    boxes, _, back = through_files(tmp_path, 200, *CALIBRATIONS[calibration])
    np.testing.assert_allclose(back[:, :6], boxes[:, :6], atol=1e-7)
    assert np.abs((back[:, 6] - boxes[:, 6] + np.pi) % (2 * np.pi) - np.pi).max() < 1e-7 + tilt**2
    assert (np.abs(back[:, 6]) <= np.pi).all()


def test_types_are_classes(root):
    kinds = [*CLASSES, "DontCare"]
    write(root / L, "".join(label_text(CAR, kind.upper()).replace("\n", " 0.9\n") for kind in kinds))
    boxes, labels = read_labels(root / L)
    assert [CLASSES[i] for i in labels] == kinds[:-1]
    np.testing.assert_array_equal(boxes, np.repeat(boxes[:1], 8, axis=0))


def test_a_split_determines_the_frames_and_the_sensor_can_be_replaced(root):
    for names in (("000007", "000003"), ("000007",)):
        write(root / S, "\n".join(names) + "\n")
        assert KittiFrames(root, "val").names == names
    assert KittiFrames(root, sensor=TINY).frame(1).points[1, 3] == 1


GOOD = label_text(CAR).split()


def label(**changes) -> str:
    names = ["kind", *range(7), *"hwlxyz", "ry"]
    return "\n" + " ".join(changes.get(name, value) for name, value in zip(names, GOOD, strict=True))


L, C, S = "training/label_2/000007.txt", "training/calib/000007.txt", "ImageSets/val.txt"
BAD = {
    "short line": (L, " ".join(GOOD[:-1]), "line 1: got 14 values, expected 15"),
    "type": (L, label(kind="Bicycle"), "line 2: type: got 'Bicycle', expected Car"),
    "NaN": (L, label(ry="nan"), "line 2: rotation_y: got 'nan', expected a finite number"),
    "absurd place": (L, label(z="1e30"), "line 2: z: got 1e+30, expected a finite number"),
    "no text": (L, b"\xff\xfe", "expected text: 'utf-8' codec can't decode byte 0xff in position 0"),
    "no label": (L, None, "no such file, expected one for every cloud"),
    "no calibration": (C, None, "no such file, expected one for every cloud"),
    "no matrix": (C, calibration_text().replace("R0_rect", "R1_rect"), "R0_rect: missing, expected P2, R0_rect"),
    "far away": (C, calibration_text().replace(f"{SHIFT[0]:.12e}", "1e7"), "takes box 0 of the labels far away"),
    "mirrored": (C, calibration_text(mounted=-MOUNTED), "line 4: Tr_velo_to_cam: got no rotation"),
    "identity": (C, calibration_text(np.eye(3), np.eye(3)), "Tr_velo_to_cam: got 'y at 90 degrees from down'"),
    "wide image": (C, re.sub("6.060*e[+]02", "960", calibration_text()), "P2: got a principal point of [960.0, "),
    "degrees": (L, label(ry="-90"), "line 2: yaw: got -90, expected a finite number, at m"),
    "unknown frame": (S, "000007\n../label_2/000007\n", "line 2: got '../label_2/000007', expected the name of"),
    "empty split": (S, "\n", "no frame in it, expected at least one"),
}


@pytest.mark.parametrize("case", BAD)
def test_damaged_files_are_refused(root, case):
    file, content, message = BAD[case]
    write(root / S, "\ufeff000007\n")  # as editors of Windows write it
    (root / file).unlink(missing_ok=True)
    if content is not None:
        (root / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    with refused(message, root / file):
        KittiFrames(root, "val").frame(0)


def test_missing_folders_and_splits_are_refused(root):
    write(root / "ImageSets" / "train.txt", "000007\n")
    with refused("split: got 'trian', expected train"):
        KittiFrames(root, "trian")
    with refused(f"{root}/training/training/velodyne: no .bin file in it"):
        KittiFrames(root / "training")
