"""Lists of sweeps with poses: fusion in the frame of the newest, one-line errors."""

import dataclasses
import json

import numpy as np
import pytest
from refusal import refused
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.sweeps import check_poses, read_sweeps
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY

EYE = np.eye(4).tolist()


def entry(file="a.npy", timestamp_us=1, sensor_to_world=EYE):
    return {"file": file, "timestamp_us": timestamp_us, "sensor_to_world": sensor_to_world}


def fuse(folder, entries, sensor=TINY, remove_close="all"):
    path = folder / "sweeps.json"
    path.write_text(json.dumps(entries))
    return read_sweeps(path, sensor, CloudReading(20, remove_close))


def test_static_points_coincide_in_listed_sweeps(tmp_path):
    """Also, the lags are exact to the microsecond."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", rng.uniform(-3, 3, (4, 1))).as_matrix()
    poses[:, :3, 3] = rng.uniform(-1000, 1000, (4, 3))
    world = poses[0, :3, 3] + rng.uniform(-20, 20, (50, 3))
    local = [(world - pose[:3, 3]) @ pose[:3, :3] for pose in poses]
    for i, points in enumerate(local):
        np.save(tmp_path / f"{i}.npy", points)
    entries = [entry(f"{i}.npy", 1_532_402_927_647_951 - 49_999 * i, p.tolist()) for i, p in enumerate(poses)]
    fused, num_close = fuse(tmp_path, entries, NUSCENES_HDL32E, "none")
    assert num_close == 0
    for i in range(4):
        part = fused[50 * i : 50 * (i + 1)]
        np.testing.assert_allclose(part[:, :3], local[0], atol=2e-4)
        np.testing.assert_array_equal(part[:, 4], np.float32(0.049999 * i))


def test_sweeps_can_be_raw_files_of_another_layout(tmp_path):
    rows = np.random.default_rng(0).uniform(3, 9, (40, 6))
    rows[:, 4] = 0.25
    rows.tofile(tmp_path / "a.bin")
    (tmp_path / "sweeps.json").write_text(json.dumps([entry("a.bin")]))
    options = {"columns": 6, "dtype": "float64"}
    fused, _ = read_sweeps(tmp_path / "sweeps.json", TINY, CloudReading(1, "all"), **options)
    np.testing.assert_array_equal(fused[:, :4], rows[:, :4].astype(np.float32))


@pytest.mark.parametrize(("mode", "counts"), [("all", [1, 1]), ("sweeps", [2, 1]), ("none", [2, 2])])
def test_close_points_are_removed_in_the_frame_of_their_own_sweep(tmp_path, mode, counts):
    np.save(tmp_path / "a.npy", np.array([[0.5, 0, 0], [10, 0, 0]]))
    entries = [entry(timestamp_us=60_000, sensor_to_world=[[1, 0, 0, 10], *EYE[1:]]), entry()]
    fused, num_close = fuse(tmp_path, entries, remove_close=mode)
    assert [int((fused[:, 4] == 0).sum()), int((fused[:, 4] > 0).sum())] == counts
    assert num_close == 4 - sum(counts)
    if mode == "all":  # the older sweep's far point, which now lies at the sensor, stays
        assert [0, 0, 0] in fused[:, :3].tolist()


def test_close_points_are_removed_around_the_origin_of_the_sensor(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[0.3, 0, 0], [2.3, 0.5, 0], [1.4, 0, 0]]))
    fused, num_close = fuse(tmp_path, [entry()], dataclasses.replace(TINY, origin_m=(1.4, 0.0, 1.6)))
    np.testing.assert_array_equal(fused[:, :3], np.array([[0.3, 0, 0]], np.float32))
    assert num_close == 2


def test_older_sweeps_may_be_empty_but_never_fill_a_current_sweep_without_usable_points(tmp_path):
    np.save(tmp_path / "a.npy", np.full((3, 3), 9.0))
    np.save(tmp_path / "none.npy", np.zeros((0, 3)))
    np.save(tmp_path / "bad.npy", np.full((2, 3), np.nan))
    np.save(tmp_path / "half.npy", np.array([[np.nan] * 3, [9.0] * 3]))
    assert fuse(tmp_path, [entry(timestamp_us=9000), entry("none.npy")])[0].shape == (3, 5)
    for name, number in (("none.npy", 0), ("bad.npy", 2), ("half.npy", 2 + 3)):
        assert fuse(tmp_path, [entry(name, timestamp_us=9000), entry()])[0].shape == (number, 5)


@pytest.mark.parametrize(
    ("rotation", "place", "message"),
    [
        ((2, 0, 0, 0), (0, 0, 0), "rotation: got [2.0, 0.0, 0.0, 0.0], expected a unit quaternion"),
        ((1e200, 0, 0, 0), (0, 0, 0), "rotation: got [1e+200, 0.0, 0.0, 0.0], expected a unit quaternion"),
        ((np.nan, 0, 0, 0), (0, 0, 0), "rotation: got [nan, 0.0, 0.0, 0.0], expected a unit quaternion"),
        ((1, 0, 0, 0), (0, np.nan, 0), "translation: got [0.0, nan, 0.0], expected finite numbers of at m"),
        ((1, 0, 0, 0), (0, 0, 1e9), "translation: got [0.0, 0.0, 1000000000.0], expected finite numbers of at m"),
    ],
)
def test_an_impossible_pose_is_refused_with_its_row_and_field(rotation, place, message):
    rotations, places = np.array([(1, 0, 0, 0), rotation], float), np.array([(0, 0, 0), place], float)
    check_poses(rotations[:1], places[:1], "pose {}".format)
    with refused(f"pose 1: {message}"):
        check_poses(rotations, places, "pose {}".format)


BAD_SWEEPS = {
    "empty": ([], "$: got [], expected array of length >= 1"),
    "no pose": ([{"file": "a.npy", "timestamp_us": 1}], "$[0]: Object missing required field `sensor_to_w"),
    "far time": ([entry(timestamp_us=10**400)], f"$[0].timestamp_us: got 1{56 * '0'}..., expected int <= 9223"),
    "far place": ([entry(sensor_to_world=[[10**400, 0, 0, 0], *EYE[1:]])], ".sensor_to_world[0][0]: Number out"),
    "too far": ([entry(sensor_to_world=[[1, 0, 0, -2e8], *EYE[1:]])], "_world[0][3]: got -200000000.0, expected"),
    "NaN": ([entry(sensor_to_world=[[np.nan, 0, 0, 0], *EYE[1:]])], "[0].sensor_to_world[0][0]: got nan, exp"),
    "last row": ([entry(sensor_to_world=[*EYE[:3], [1, 1, 1, 1]])], "$[0].sensor_to_world: got [[1.0, 0.0, 0."),
    "mirrored": ([entry(sensor_to_world=np.diag([-1, 1, 1, 1.0]).tolist())], "expected a rotation in the upper"),
    "scaled": ([entry(sensor_to_world=np.diag([2, 2, 2, 1.0]).tolist())], "expected a rotation in the upper"),
    "oldest first": (
        [entry(timestamp_us=1000 * t) for t in (9, 1, 8)],
        "$[2].timestamp_us: got 8000, expected less",
    ),
    "twice": ([entry(timestamp_us=9000), *2 * [entry(timestamp_us=1)]], "$[2].timestamp_us: got 1, expected less"),
    "nanoseconds": ([entry(timestamp_us=50 * 10**6 + 1), entry()], "timestamp_us: got 5e+07 on average, exp"),
    "milliseconds": ([entry(timestamp_us=51), entry()], "timestamp_us: got 50 on average, exp"),
}


@pytest.mark.parametrize("name", BAD_SWEEPS)
def test_invalid_lists_of_sweeps_are_refused(tmp_path, name):
    content, message = BAD_SWEEPS[name]
    np.save(tmp_path / "a.npy", np.ones((3, 3)))
    with refused(message, tmp_path / "sweeps.json"):
        fuse(tmp_path, content)
