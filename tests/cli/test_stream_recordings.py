"""``fcos-lidar stream``: the same boxes, bit for bit, whatever form a drive was recorded in."""

import dataclasses
import json
import re

import numpy as np
import pytest
from commands import assert_one_line_error, command
from made_argoverse2 import STEP_NS, make_log
from made_bags import FORMS, structured, write_recording
from scipy.spatial.transform import Rotation
from tiny_run import TINY_CONFIG, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame

SWEEPS, WINDOW, START_NS, STEP = 5, 3, 1_700_000_000_000_000_000, 100_000_000


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A detector of three sweeps and a drive: a folder with poses as JSON and TUM, and recordings of all forms."""
    folder = tmp_path_factory.mktemp("home")
    config = dataclasses.replace(TINY_CONFIG, num_sweeps=WINDOW)
    save_checkpoint(folder / "checkpoint", Checkpoint(config, TINY, untrained(config, TINY), 7))
    (folder / "drive").mkdir()
    rng, stamps = np.random.default_rng(0), [START_NS + index * STEP for index in range(SWEEPS)]
    clouds = [make_frame(index, TINY).points for index in range(SWEEPS)]
    places = rng.normal(0, 2, (SWEEPS, 3))
    turns = Rotation.from_euler("zy", [[0.1 * index, 0.01] for index in range(SWEEPS)]).as_quat()
    listed, lines = [], []
    for stamp, cloud, place, turn in zip(stamps, clouds, places, turns, strict=True):
        name = f"{stamp}.npy"
        np.save(folder / "drive" / name, cloud)
        lines.append(" ".join(map(repr, [stamp / 1e9, *place.tolist(), *turn.tolist()])))
        pose = pose_matrix(turn[[3, 0, 1, 2]], place).tolist()
        listed.append({"file": f"drive/{name}", "timestamp_us": stamp // 1000, "sensor_to_world": pose})
    (folder / "poses.txt").write_text("\n".join(lines))
    (folder / "poses.json").write_text(json.dumps(listed))

    def content(make):
        yield "/imu", make.text("nothing")
        for stamp, cloud, place, turn in zip(stamps, clouds, places, turns, strict=True):
            yield "/odom", make.odometry(stamp, place, turn, "lidar")
            yield "/tf", make.transform(stamp, "odom", "lidar", place, turn)
            yield "/points", make.cloud(stamp, structured(cloud))

    for form in FORMS:
        write_recording(folder / form.replace(" ", "_"), form, content)
    return folder


def recording(home, form):
    place = home / form.replace(" ", "_")
    return {"ros1": place.with_suffix(".bag"), "mcap file": place / f"{place.name}.mcap"}.get(form, place)


def stream(home, out, source, *more):
    command("stream", source, "--checkpoint", home / "checkpoint", "--out", out, *more)
    return [json.loads(line) for line in out.read_text().splitlines()]


def without_file(lines):
    assert len(lines[0]["boxes"]) > 0
    return [{name: value for name, value in line.items() if name != "file"} for line in lines]


def test_all_forms_of_a_drive_have_the_same_boxes(home, tmp_path):
    out = tmp_path / "boxes.jsonl"
    expected = without_file(stream(home, out, home / "drive", "--poses", home / "poses.json"))
    assert [line["timestamp_us"] for line in expected] == [(START_NS + i * STEP) // 1000 for i in range(SWEEPS)]
    assert without_file(stream(home, out, home / "drive", "--poses", home / "poses.txt")) == expected
    for form, how in zip(FORMS, ("/odom --topic /points", "tf", "/odom", "tf --topic /points"), strict=True):
        source = recording(home, form)
        lines = stream(home, out, source, f"--odometry {how}")
        assert without_file(lines) == expected, form
        assert lines[2]["file"] == f"{source}: /points: message 2"
    window = home / "window.json"
    window.write_text(json.dumps(json.loads((home / "poses.json").read_text())[-WINDOW:][::-1]))
    command("detect --sweeps", window, "--checkpoint", home / "checkpoint", "--out", tmp_path / "b.json")
    [last] = json.loads((tmp_path / "b.json").read_text())["files"]
    assert last["boxes"] == expected[-1]["boxes"]


def test_without_odometry_lines_have_times_and_no_poses(home, tmp_path, capsys):
    lines = stream(home, tmp_path / "a.jsonl", recording(home, "mcap"))
    assert capsys.readouterr().err.count("no poses: every sweep is detected on its own") == 1
    assert [(line["timestamp_us"], line["sensor_to_world"]) for line in lines] == [
        ((START_NS + i * STEP) // 1000, None) for i in range(SWEEPS)
    ]


def test_a_line_tells_the_time_of_each_stage(home, tmp_path, capsys):
    stream(home, tmp_path / "a.jsonl", recording(home, "ros1"), "--odometry tf --page", tmp_path / "page.html")
    number = r"\d+\.\d"
    line = (
        rf"5 sweeps: the first, which compiles, {number} s; the others ({number}) ms reading, ({number}) ms "
        rf"detection, ({number}) ms writing \(medians\), 0 compilations"
    )
    found = [match for text in capsys.readouterr().err.splitlines() if (match := re.fullmatch(line, text))]
    assert len(found) == 1
    assert float(found[0][2]) > 0


MISTAKES = {
    "topics of a folder": ("HOME/drive --topic /points", "--topic: expected only with a ROS recording"),
    "poses twice": (
        "HOME/ros1.bag --odometry tf --poses HOME/poses.txt",
        "--poses: expected only with .* without --odom",
    ),
    "layout of a recording": (
        "HOME/ros1.bag --columns 4",
        "--columns: expected only with a folder of point files",
    ),
    "no such topic": (
        "HOME/ros1.bag --topic /x",
        r"ros1.bag: topic: got '/x', .*: /points \(sensor_msgs/msg/Point",
    ),
    "tracks without poses": ("HOME/ros1.bag --track", "--track: found no poses, expected .*--odometry"),
    "no such recording": ("HOME/other.bag", "other.bag: no such file or folder"),
    "no recording": ("HOME/poses.mcap", "poses.mcap: cannot be read: File magic is invalid"),
    "poses of another time": (
        "HOME/ros1.bag --poses HOME/late.txt",
        "late.txt: .*/points: message 0: at 17.* a gap",
    ),
    "out into the recording": ("HOME/ros1.bag --page HOME/ros1.bag", "--page: .*the same file"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_one_line(home, tmp_path, capsys, case):
    (home / "poses.mcap").write_text("no recording")
    (home / "late.txt").write_text("1 0 0 0 0 0 0 1")
    text, message = MISTAKES[case]
    args = ["stream", *text.replace("HOME", str(home)).split(), "--checkpoint", str(home / "checkpoint")]
    assert_one_line_error(capsys, [*args, "--out", str(tmp_path / "boxes.jsonl")], message)


def test_time_going_back_is_one_line_after_what_came_before(home, tmp_path, capsys):
    cloud = structured(make_frame(0, TINY).points)
    times = (5000, 4000)
    bag = write_recording(tmp_path / "a", "sqlite", lambda make: (("/p", make.cloud(t, cloud)) for t in times))
    out = tmp_path / "boxes.jsonl"
    args = ["stream", str(bag), "--checkpoint", str(home / "checkpoint"), "--out", str(out)]
    assert_one_line_error(capsys, args, r"a: /p: message 1: time: got 4 us, expected more than the 5 us of")
    assert len(out.read_text().splitlines()) == 1


def test_a_log_of_argoverse2_is_a_source(home, tmp_path):
    log = make_log(tmp_path / "log", 0, sweeps=4, sensor=dataclasses.replace(TINY, row_source="laser"))
    lines = stream(home, tmp_path / "a.jsonl", log)
    frames = Argoverse2Frames(log)
    assert [line["timestamp_us"] for line in lines] == [frames.time_us(i) for i in range(4)]
    assert np.diff([line["timestamp_us"] for line in lines]).tolist() == [STEP_NS // 1000] * 3
    for index, line in enumerate(lines):
        assert line["sensor_to_world"] == frames.pose(index).tolist()
    # As from a folder with the same clouds and poses, where the file is of the same kind.
    listed = [
        {key: line[key] for key in ("file", "timestamp_us", "sensor_to_world")}
        | {"file": line["file"].removeprefix(f"{tmp_path}/")}
        for line in lines
    ]
    (tmp_path / "poses.json").write_text(json.dumps(listed))
    folder = log / "sensors" / "lidar"
    assert stream(home, tmp_path / "b.jsonl", folder, "--poses", tmp_path / "poses.json") == lines


@pytest.mark.real_data
def test_a_real_scene_has_the_same_boxes_in_all_forms(real_data, home, tmp_path):
    root, out = real_data / "nuscenes_scene0523", tmp_path / "boxes.jsonl"
    # The index brings the tables' quaternions to unit length, which changes last digits: all have the index's.
    index = NuScenes(root, "v1.0-scene0523").index
    [scene], rows = set(index.scene_name.astype(str).tolist()), index.sample_sweep

    def content(make):
        mount = index.sweep_sensor[rows[0]]
        extrinsic = index.sensor_translation[mount], index.sensor_rotation[mount][[1, 2, 3, 0]]
        yield "/tf_static", make.transform(0, "base_link", "lidar", *extrinsic)
        for row in rows.tolist():
            stamp = int(index.sweep_time_us[row]) * 1000
            points = np.fromfile(root / index.sweep_file[row].decode(), np.float32).reshape(-1, 5)
            ego = index.ego_translation[row], index.ego_rotation[row][[1, 2, 3, 0]]
            yield "/odom", make.odometry(stamp, *ego)
            yield "/points", make.cloud(stamp, structured(points))

    how = "--keyframes --checkpoint", home / "checkpoint", "--out", out
    command("stream --data-root", root, "--scene", scene, *how)
    expected = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(expected) == len(rows) == 40
    lines = [
        {"file": line["file"], "timestamp_us": line["timestamp_us"], "sensor_to_world": line["sensor_to_world"]}
        for line in expected
    ]
    (tmp_path / "poses.json").write_text(json.dumps(lines))
    folder = root / "samples" / "LIDAR_TOP"
    assert stream(home, out, folder, "--poses", tmp_path / "poses.json") == expected
    for form in ("ros1", "sqlite", "mcap"):
        bag = write_recording(tmp_path / form.replace(" ", "_"), form, content)
        assert without_file(stream(home, out, bag, "--odometry /odom")) == without_file(expected), form
