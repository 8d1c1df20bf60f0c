"""Drives: clouds with poses from files, and scenes of nuScenes."""

import json
from pathlib import Path

import numpy as np
import pytest
from made_nuscenes import BETWEEN, KEYFRAMES, VERSION, make_tables, write
from refusal import refused
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.drives import Drive, folder_drive, read_tum
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.input_pipeline.open_drive import SCENE
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY

CLOUD = np.array([[5, 0, 0, 1, 0]], np.float32)


@pytest.fixture
def poses(tmp_path):
    """Poses at 0 and 0.4 s: two metres on, and a quarter of a turn."""
    half = float(np.sqrt(0.5))
    (tmp_path / "poses.txt").write_text(f"0 1 0 0 0 0 0 1\n\n0.4 3 0 0 0 0 {half} {half}\n")
    (tmp_path / "clouds").mkdir()
    return tmp_path


def drive_of(folder, *names, poses="poses.txt"):
    """Write clouds and open the drive with their poses."""
    for name in names:
        np.save(folder / "clouds" / f"{name}.npy", CLOUD)
    return folder_drive(folder / "clouds", TINY, poses and folder / poses)


def names_of(sweeps):
    return [Path(sweep.name).stem for sweep in sweeps]


def test_poses_are_interpolated_if_file_names_are_times(poses):
    drive = drive_of(poses, "0.0", "0.1", "0.4")
    for sweep, share in zip(drive.sweeps, (0, 0.25, 1), strict=True):
        assert sweep.time_us == 400_000 * share
        expected = Rotation.from_euler("z", 90 * share, degrees=True).as_matrix()
        np.testing.assert_allclose(sweep.sensor_to_world[:3, :3], expected, atol=1e-12)
        np.testing.assert_allclose(sweep.sensor_to_world[:3, 3], (1 + 2 * share, 0, 0), atol=1e-12)


def test_clouds_named_by_times_are_in_temporal_order(poses):
    (poses / "poses.txt").write_text("9.8 0 0 0 0 0 0 1\n10.2 4 0 0 0 0 0 1\n")
    sweeps = list(drive_of(poses, "9.9", "10.0", "10.1", "9.8").sweeps)
    assert names_of(sweeps) == names_of(drive_of(poses, poses=None).sweeps) == ["9.8", "9.9", "10.0", "10.1"]
    assert [sweep.time_us for sweep in sweeps] == [9_800_000, 9_900_000, 10_000_000, 10_100_000]
    np.testing.assert_allclose([sweep.sensor_to_world[0, 3] for sweep in sweeps], [0, 1, 2, 3], atol=1e-12)


@pytest.mark.parametrize("digits", ["123455", "123456789", "123457"])
def test_times_that_differ_by_rounding_match(poses, digits):
    (poses / "poses.txt").write_text(f"1700000000.{digits} 4 0 0 0 0 0 1\n")
    [sweep] = drive_of(poses, "1700000000123456789").sweeps
    assert (sweep.time_us, sweep.sensor_to_world[0, 3]) == (1_700_000_000_123_456, 4)
    (poses / "clouds" / "1700000000123456789.npy").rename(poses / "clouds" / "1700000000123456.npy")
    assert [sweep.time_us for sweep in drive_of(poses).sweeps] == [1_700_000_000_123_456]


@pytest.mark.parametrize(
    ("numbers", "places_m", "step_s", "told"),
    [
        ((9, 9, 9, 9), (0, 3, 6, 9), 0.1, ""),
        ((9, 0, 20, 9), (0, 3, 6, 9), 0.1, ""),  # empty clouds are told elsewhere
        ((9, 9, 30, 9), (0, 3, 6, 9), 0.1, "2: it has 30 points, after 9 of 1"),
        ((9, 2, 9, 2), (0, 3, 6, 9), 0.1, "1: it has 2 points, after 9 of 0"),
        ((9, 9, 9, 9), (0, 40, 0, 40), 0.1, "1: its pose is 40.0 m away, 0.1 s after 0"),
        ((9, 9, 9, 9), (0, 3, 6, 9), 100, "1: its time is 100 s after 0"),  # nanoseconds
    ],
)
def test_clouds_that_jump_are_told_once(capsys, numbers, places_m, step_s, told):
    sweeps = []
    for i, (number, x) in enumerate(zip(numbers, places_m, strict=True)):
        pose = np.eye(4)
        pose[0, 3] = x
        sweeps.append(Sweep(np.repeat(CLOUD, number, axis=0), pose, round(i * step_s * 1e6), str(i)))
    assert list(Drive(sweeps).sweeps) == sweeps
    expected = f"note: {told}: clouds of several sensors or drives?\n" if told else ""
    assert capsys.readouterr().err == expected


def test_clouds_with_other_names_need_one_pose_each(poses):
    sweeps = list(drive_of(poses, "b", "a").sweeps)
    assert names_of(sweeps) == ["a", "b"]
    assert [(sweep.time_us, sweep.sensor_to_world[0, 3]) for sweep in sweeps] == [(0, 1), (400_000, 3)]
    with refused("poses.txt: got 2 poses for 3 clouds, expected one per cloud"):
        drive_of(poses, "c")


def test_names_that_are_not_sorted_by_their_numbers_are_refused(poses):
    for file, where in (("poses.txt", "poses.txt"), (None, "clouds")):
        with refused(f"{where}: clouds are sorted by name: got sweep_10.npy before sweep_9.npy, expected numbers"):
            drive_of(poses, "sweep_9", "sweep_10", poses=file)
    (poses / "clouds" / "sweep_9.npy").rename(poses / "clouds" / "sweep_09.npy")
    drive = drive_of(poses, "._sweep_09")  # hidden files of macOS are skipped
    assert names_of(drive.sweeps) == ["sweep_09", "sweep_10"]


@pytest.mark.parametrize(
    ("names", "gap_us", "message"),
    [
        ("aba", 50_000, "poses.json: got 3 entries for 2 clouds, expected each once"),
        ("b", 50_000, "poses.json: no pose of"),
        ("ab", 50, "poses.json: timestamp_us: got 50 on average, expected microseconds, 1000 to"),
    ],
)
def test_a_list_needs_every_cloud_once_and_microseconds(poses, names, gap_us, message):
    pose = {"sensor_to_world": np.eye(4).tolist()}
    listed = [{"file": f"clouds/{n}.npy", "timestamp_us": gap_us * i, **pose} for i, n in enumerate(names)]
    (poses / "poses.json").write_text(json.dumps(listed))
    with refused(message):
        drive_of(poses, "a", poses="poses.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0 0 0 0 0 1\n9 0 0 0 0 0 0 1", "0.1.npy: at 0.1 s: a gap in the poses"),
        ("8 0 0 0 0 0 0 1", "0.1.npy: at 0.1 s: a gap in the poses"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1", "line 2: time: got 0.0 s after 0.0 s, expected a later one"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 7", "line 2: rotation: got [7.0, 0.0, 0.0, 0.0], expected a unit"),
        ("1 2 3", "line 1: got '1 2 3', expected t x y z qx qy qz qw"),
        ("# t\n1 0 0 nan 0 0 0 1", "line 2: got 'nan', expected a finite number"),
        ("1e999 0 0 0 0 0 0 1", "line 1: got '1e999', expected a finite number of at most 1e+12"),
        ("# nothing", "no pose in it"),
        (None, "no such file"),
    ],
)
def test_poses_that_do_not_fit_are_refused(poses, text, message):
    file = poses / "poses.txt"
    file.unlink() if text is None else file.write_text(text)
    with refused(message, file):
        drive_of(poses, "0.1")


def test_poses_that_turn_z_down_are_told(tmp_path, capsys):
    """The quaternion's scalar comes last."""
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 1 0 0 0\n")
    read_tum(tmp_path / "poses.txt")
    expected = "poses.txt: line 2: turns z down: expected t x y z qx qy qz qw, with qw last\n"
    assert capsys.readouterr().err == f"note: {tmp_path}/{expected}"


def test_a_scene_consists_of_all_its_sweeps_or_its_keyframes(tmp_path):
    data = NuScenes(write(tmp_path, *make_tables()), VERSION)
    sweeps, keyframes = list(data.drive("scene-1")), list(data.drive("scene-1", keyframes=True))
    assert len(sweeps) == KEYFRAMES * BETWEEN
    assert len(keyframes) == KEYFRAMES
    assert np.diff([sweep.time_us for sweep in sweeps]).min() > 0
    reading = CloudReading(10, "all")
    for number, token in enumerate(data.split("scene-1")):
        assert keyframes[number].name == sweeps[number * BETWEEN].name
        window = sweeps[max(0, number * BETWEEN - 2) : number * BETWEEN + 1][::-1]
        fused, _ = fuse_sweeps(window, NUSCENES_HDL32E, reading)
        np.testing.assert_array_equal(fused, data.sweeps(token, 3))
    tokens = data.keyframe_tokens("scene-1")
    assert [tokens[keyframe.time_us] for keyframe in keyframes] == list(data.split("scene-1"))
    with refused("scene: got 'scene-7', expected"):
        data.drive("scene-7")


def test_missing_sweeps_are_skipped_if_allowed_but_a_scene_needs_keyframes(tmp_path):
    root = write(tmp_path, *make_tables())
    number = len(list(NuScenes(root, VERSION).drive("scene-1")))
    data = NuScenes(root, VERSION)
    (root / list(data.drive("scene-1"))[1].name).unlink()
    for opening in (
        lambda: data.drive("scene-1"),
        lambda: SCENE.open(root, TINY, scene="scene-1", version=None, keyframes=True, num_sweeps=2),
    ):
        with refused("no such file, expected a sweep that sample_data.json names"):
            opening()  # before the first sweep is read
    assert len(list(NuScenes(root, VERSION, allow_missing_sweeps=True).drive("scene-1"))) == number - 1
    options = {"version": None, "keyframes": True, "allow_missing_sweeps": True}
    for num_sweeps, expected in ((1, []), (2, ["skipped 1 of 12 sweeps, whose files are missing"])):
        drive = SCENE.open(root, TINY, scene="scene-1", num_sweeps=num_sweeps, **options)
        assert drive.notes == expected
    data = NuScenes(root, VERSION, allow_missing_sweeps=True)
    *_, last = data.drive("scene-1", keyframes=True)
    (root / last.name).unlink()
    for keyframes in (False, True):
        with refused(f"{last.name}: no such file, expected a sweep that sample_data.json names"):
            data.drive("scene-1", keyframes=keyframes)
    scenes = root / VERSION / "scene.json"
    rows = json.loads(scenes.read_text())
    scenes.write_text(json.dumps([*rows, rows[0] | {"token": "9" * 32, "name": "scene-9"}]))
    with refused("sample.json: scene scene-9: found no keyframe, expected one"):
        NuScenes(root, VERSION).drive("scene-9")


def test_overflowing_coordinates_become_infinite_without_a_warning():
    """The cloud policy then removes and counts them."""
    turned = np.eye(4)
    turned[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    points = np.full((2, 5), 3e38, np.float32)
    points[1] = np.array([0x7F800001], np.uint32).view(np.float32)  # a signalling NaN
    sweeps = [Sweep(points, np.eye(4), 50_000), Sweep(points, turned, 0)]
    fused, _ = fuse_sweeps(sweeps, TINY, CloudReading(10, "all"))
    assert fused.shape == (4, 5)
    assert np.isinf(fused[2, 1])
    assert np.isnan(fused[[1, 3], :3]).all()
