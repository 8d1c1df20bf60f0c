"""Clouds of other axes: rotated and shifted for the detector, and boxes transformed back."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from refusal import refused

from fcos_lidar_jax.inference.alignment import Alignment, align
from fcos_lidar_jax.sensors import KITTI_HDL64E, NUSCENES_HDL32E, TINY, VLP16
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import Detections


def test_boxes_are_brought_back_by_the_inverse_of_rotation_matrices():
    data = dataclasses.replace(TINY, forward_rad=0.4, origin_m=(1.0, 2.0, 0.5))
    detector = dataclasses.replace(TINY, forward_rad=-1.1, origin_m=(0.0, -1.0, 0.2))
    cos, sin = np.cos(-1.5), np.sin(-1.5)
    matrix = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    rng = np.random.default_rng(0)
    points = rng.uniform(-9, 9, (20, 5)).astype(np.float32)
    aligned = Alignment(data, detector)
    expected = (points[:, :3] - data.origin_m) @ matrix.T + detector.origin_m
    np.testing.assert_allclose(aligned.points(points)[:, :3], expected, atol=1e-5)
    points[0, 0] = np.inf
    assert np.isfinite(aligned.points(points)[:, :3]).all(axis=1).tolist() == [False] + [True] * 19  # no warning
    boxes = rng.uniform(-3, 3, (6, 9)).astype(np.float32)
    back = aligned.back(Detections(boxes, np.ones(6), np.zeros(6, int), np.ones(6, bool), np.int32(0))).boxes
    np.testing.assert_allclose(back[:, :3], (boxes[:, :3] - detector.origin_m) @ matrix + data.origin_m, atol=1e-5)
    np.testing.assert_array_equal(back[:, 3:6], boxes[:, 3:6])
    np.testing.assert_allclose(np.exp(1j * back[:, 6]), np.exp(1j * (boxes[:, 6] + 1.5)), atol=1e-5)
    np.testing.assert_allclose(back[:, 7:], boxes[:, 7:] @ matrix[:2, :2], atol=1e-5)
    turned = Alignment(dataclasses.replace(TINY, forward_rad=np.pi), dataclasses.replace(TINY, forward_rad=0.0))
    back = turned.back(Detections(0 * boxes, np.ones(6), np.zeros(6, int), np.ones(6, bool), np.int32(0))).boxes
    np.testing.assert_array_equal(back[:, 6], np.float32(-np.pi))


def test_clouds_that_a_given_angle_brings_to_y_ahead_have_x_ahead():
    assert align(NUSCENES_HDL32E, yaw_rad=np.pi / 2).data.forward_rad == 0.0
    assert align(NUSCENES_HDL32E).data == NUSCENES_HDL32E
    assert align(VLP16, yaw_rad=1.0).data.forward_rad is None


def test_one_line_says_what_is_done():
    line = Alignment(KITTI_HDL64E, NUSCENES_HDL32E).describe()
    assert line == "clouds rotated by 90 degrees, and boxes transformed back: the detector expects y ahead"
    assert Alignment(VLP16, NUSCENES_HDL32E).describe() == "" == Alignment(TINY, NUSCENES_HDL32E).describe()


def test_a_sensor_with_another_number_of_rows_gives_a_warning(capsys):
    aligned = align(NUSCENES_HDL32E, VLP16)
    assert capsys.readouterr().err == ""
    for _ in range(2):
        aligned.tell_notes()
    expected = "warning: vlp16 has 16 rows, and the detector's sensor 32: expect poor detections"
    assert capsys.readouterr().err.count(expected) == 1
    assert align(NUSCENES_HDL32E, dataclasses.replace(NUSCENES_HDL32E, forward_rad=0.0)).notes == ()


def test_files_of_several_sensors_and_wrong_scales_are_refused(tmp_path):
    kitti, other = tmp_path / "training" / "velodyne" / "000000.bin", tmp_path / "cloud.bin"
    with refused(
        f"{kitti} of kitti_hdl64e and {other} of another, expected files of one sensor, or --data-sensor"
    ):
        align(NUSCENES_HDL32E, paths=[kitti, other])
    with refused("intensity_scale: got -1.0, expected within (0, 1e+09]"):
        align(NUSCENES_HDL32E, intensity_scale=-1.0)


def test_clouds_of_another_sensor_are_announced(capsys):
    Alignment(TINY, NUSCENES_HDL32E).announce(make_frame(0, TINY).points)
    assert "warning: points do not fit sensor 'nuscenes_hdl32e'" in capsys.readouterr().err
    Alignment(TINY, TINY).announce(make_frame(0, TINY).points)
    assert "warning" not in capsys.readouterr().err


def test_options_stand_for_the_sensor_of_the_data():
    """An angle takes the place of the turn between the sensors, and a factor that of their scale."""
    kitti = [Path("x/training/velodyne/000000.bin")]
    for options, turn, scale in (
        ({}, np.pi / 2, 255.0),
        ({"yaw_rad": 0.0}, 0.0, 255.0),
        ({"yaw_rad": 0.0, "intensity_scale": 1.0}, 0.0, 1.0),
        ({"sensor": NUSCENES_HDL32E}, 0.0, 1.0),
    ):
        aligned = align(NUSCENES_HDL32E, paths=kitti, **options)
        pose = np.eye(4) if aligned.pose is None else aligned.pose
        assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(turn)
        assert aligned.data.intensity_scale == scale


UNKNOWN = dataclasses.replace(TINY, forward_rad=None)
FILES = [Path("a.npy")]
NOT_DECLARED = (
    "note: the heading of the clouds is not declared (--data-sensor, --yaw-deg): the detector expects y ahead\n"
)
NOT_ROTATED = (
    "note: clouds are not rotated, since the heading of {} is unknown (forward_rad){}; --yaw-deg rotates them\n"
)


@pytest.mark.parametrize(
    ("aligned", "expected"),
    [
        (align(TINY, paths=FILES), NOT_DECLARED),
        (align(TINY, TINY, paths=FILES), ""),
        (align(TINY, paths=FILES, yaw_rad=0.0), ""),
        (align(VLP16, paths=FILES), ""),
        (align(NUSCENES_HDL32E, paths=[Path("LIDAR_TOP/a.pcd.bin")]), ""),
        (align(NUSCENES_HDL32E, paths=[Path("n015__LIDAR_TOP__7.pcd.bin")]), ""),
        (align(TINY, UNKNOWN), NOT_ROTATED.format("their sensor", ": the detector expects y ahead")),
        (Alignment(TINY, UNKNOWN), NOT_ROTATED.format("the detector's sensor", "")),
        (Alignment(UNKNOWN, TINY, yaw_rad=0.0), ""),
        (align(UNKNOWN), ""),
    ],
)
def test_a_note_says_if_a_heading_is_unknown(aligned, expected, capsys):
    aligned.tell_notes()
    assert capsys.readouterr().err == expected
