"""KITTI raw recordings: poses from GPS and inertial unit; one-line errors."""

from pathlib import Path

import numpy as np
import pytest
from made_kitti import write_raw_drive
from refusal import refused

from fcos_lidar_jax.data.kitti_raw import is_kitti_raw, kitti_raw_drive
from fcos_lidar_jax.sensors import KITTI_HDL64E

METRES_A_DEGREE = 6_378_137 * np.pi / 180
YAW = 0.5


@pytest.fixture
def recording(tmp_path):
    """Two sweeps near Karlsruhe: 8 m to the east and 6 m to the north in 0.1 s; the LiDAR ahead of the IMU."""
    east = 8 / METRES_A_DEGREE / np.cos(np.deg2rad(49))
    clouds = [np.full((3, 4), [5 + index, 1, 0, 0.5]) for index in range(2)]
    places = [(49 + index * 6 / METRES_A_DEGREE, 8.4 + index * east, 110 + index) for index in range(2)]
    poses = [" ".join(map(str, (*place, 0, 0, YAW, 1, 2, 3))) for place in places]
    return write_raw_drive(tmp_path / "day", clouds, poses)


def test_poses_follow_from_the_positions_on_the_ground(recording):
    assert is_kitti_raw(recording)
    assert not is_kitti_raw(recording.parent)
    first, second = kitti_raw_drive(recording, KITTI_HDL64E).sweeps
    assert second.time_us - first.time_us == 100_000
    assert first.time_us == 1_317_042_145_594_360
    moved = second.sensor_to_world[:3, 3] - first.sensor_to_world[:3, 3]
    np.testing.assert_allclose(moved, (8, 6, 1), atol=1e-3)
    cos, sin = np.cos(YAW), np.sin(YAW)
    for sweep in (first, second):
        np.testing.assert_allclose(sweep.sensor_to_world[:2, :2], [[cos, -sin], [sin, cos]], atol=1e-12)
    # The IMU, which stands at (-0.8, 0.3, -0.8) of the LiDAR's frame, is at its own altitude.
    assert (first.sensor_to_world @ [-0.8, 0.3, -0.8, 1])[2] == pytest.approx(110)
    assert first.points[0].tolist() == [5, 1, 0, 127.5, 0]


def test_the_calibration_of_the_day_is_found_from_within_the_drive(recording, monkeypatch):
    monkeypatch.chdir(recording)
    assert len(list(kitti_raw_drive(Path(), KITTI_HDL64E).sweeps)) == 2


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("oxts/data/0000000001.txt", None, "0000000001.txt: no such file"),
        ("oxts/data/0000000001.txt", "49 8 110 0 x 0", "0000000001.txt: pitch: got 'x', expected a fi"),
        ("oxts/data/0000000001.txt", "49 8 110 0", "0000000001.txt: got 4 numbers, expected at least 6"),
        ("oxts/data/0000000000.txt", "90 8 110 0 0 0", "latitude: got '90', expected a finite number of at m"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25.5", "line 2: time of 0000000001.bin: Invalid iso"),
        ("velodyne_points/timestamps.txt", "today\n", "line 1: time of 0000000000.bin: Invalid isoformat string"),
        ("../calib_imu_to_velo.txt", None, "calib_imu_to_velo.txt: no such file"),
        ("../calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 -1\nT: 0 0 0", "line 1: R: got no rotation in its 3x3"),
        ("../calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 1", "calib_imu_to_velo.txt: T: missing, expected R, T"),
    ],
)
def test_missing_and_damaged_files_are_refused(recording, file, text, message):
    (recording / file).unlink() if text is None else (recording / file).write_text(text)
    with refused(message):
        list(kitti_raw_drive(recording, KITTI_HDL64E).sweeps)
