"""``fcos-lidar stream``: the boxes of ``detect --sweeps``, from all kinds of poses; one line for every mistake."""

import dataclasses
import json

import numpy as np
import pytest
from commands import assert_one_line_error, command, page_content
from scipy.spatial.transform import Rotation
from tiny_run import TINY_CONFIG, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, save_checkpoint
from fcos_lidar_jax.cli import main
from fcos_lidar_jax.cli import stream as cli_stream
from fcos_lidar_jax.inference.stream import detect_stream
from fcos_lidar_jax.sensors import TINY, sensor_to_json
from fcos_lidar_jax.simulation.frames import make_frame

SWEEPS, WINDOW, STEP_US = 5, 3, 100_000


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A detector of three sweeps, a drive with poses as JSON and TUM, and what ``detect`` finds in it."""
    folder = tmp_path_factory.mktemp("home")
    config = dataclasses.replace(TINY_CONFIG, num_sweeps=WINDOW)
    save_checkpoint(folder / "checkpoint", Checkpoint(config, TINY, untrained(config, TINY), 7))
    (folder / "drive").mkdir()
    rng, listed, lines = np.random.default_rng(0), [], ["# t x y z qx qy qz qw"]
    for index in range(SWEEPS):
        turn, place = Rotation.from_euler("zy", [0.1 * index, 0.01]), rng.normal(0, 2, 3)
        name, time_us = f"{(10**6 + index * STEP_US) / 1e6:.6f}.npy", 10**6 + index * STEP_US
        np.save(folder / "drive" / name, make_frame(index, TINY).points)
        pose = np.eye(4)
        quaternion = [float(f"{v:.9f}") for v in turn.as_quat()]
        lines.append(" ".join(map(repr, [time_us / 1e6, *place.tolist(), *quaternion])))
        x, y, z, w = np.array(quaternion)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), place
        listed.append({"file": f"drive/{name}", "timestamp_us": time_us, "sensor_to_world": pose.tolist()})
    (folder / "poses.json").write_text(json.dumps(listed))
    (folder / "poses.txt").write_text("\n".join(lines))
    (folder / "backwards.json").write_text(json.dumps(listed[::-1]))
    (folder / "short.json").write_text(json.dumps(listed[:-1]))
    (folder / "gap.txt").write_text("\n".join([lines[1], "9 0 0 0 0 0 0 1"]))
    (folder / "twice.txt").write_text("\n".join([lines[1], lines[1]]))
    (folder / "words.txt").write_text("1 2 3")
    (folder / "long.txt").write_text("\n".join([lines[1], "2 0 0 0 0 0 0 7"]))
    (folder / "none.txt").write_text("# nothing")
    return folder


def stream(home, out, *more):
    command("stream", home / "drive", "--checkpoint", home / "checkpoint", "--out", out, *more)
    text = out.read_text()
    assert text.endswith("\n")
    return [json.loads(line) for line in text.splitlines()]


def test_the_boxes_are_those_of_detect_with_the_same_sweeps(home, tmp_path, capsys):
    lines = stream(home, tmp_path / "boxes.jsonl", "--poses", home / "poses.json")
    listed = json.loads((home / "poses.json").read_text())
    assert len(lines) == SWEEPS
    for index, line in enumerate(lines):
        window, out = home / "window.json", tmp_path / "boxes.json"
        window.write_text(json.dumps(listed[: index + 1][::-1]))
        capsys.readouterr()
        command("detect --sweeps", window, "--checkpoint", home / "checkpoint", "--out", out)
        said = f"{window}: fuses the first {WINDOW} of {index + 1} sweeps, as the detector was trained"
        assert (said in capsys.readouterr().err) == (index >= WINDOW)
        [expected] = json.loads(out.read_text())["files"]
        assert len(expected["boxes"]) > 0
        assert {name: line[name] for name in expected if name != "file"} == {
            name: value for name, value in expected.items() if name != "file"
        }
        assert line["timestamp_us"] == listed[index]["timestamp_us"]
        assert line["file"] == str(home / listed[index]["file"])


def test_keyframes_are_detected_in_with_the_sweeps_between(home, tmp_path, capsys):
    (tmp_path / "sensor.json").write_text(json.dumps(sensor_to_json(TINY)))
    data = f"--data-root {tmp_path}/data --scene {{scene}} --checkpoint {home}/checkpoint"
    command(f"synthesize --out {tmp_path}/data --scenes 1 --keyframes 3 --sensor {tmp_path}/sensor.json")
    [scenes] = (tmp_path / "data").glob("*/scene.json")
    data = data.format(scene=json.loads(scenes.read_text())[0]["name"])
    command("stream", data, "--out", tmp_path / "all.jsonl")
    capsys.readouterr()
    command("stream", data, "--keyframes --out", tmp_path / "some.jsonl")
    assert "3 sweeps: " in capsys.readouterr().err
    every, some = (tmp_path / f"{name}.jsonl" for name in ("all", "some"))
    lines = some.read_text().splitlines()
    assert len(lines) == 3
    assert set(lines) < set(every.read_text().splitlines())


def test_lines_of_poses_give_the_same_to_their_last_digits(home, tmp_path):
    ours = stream(home, tmp_path / "a.jsonl", "--poses", home / "poses.txt")
    for line, expected in zip(
        ours, stream(home, tmp_path / "b.jsonl", "--poses", home / "poses.json"), strict=True
    ):
        assert line["timestamp_us"] == expected["timestamp_us"]
        np.testing.assert_allclose(line["sensor_to_world"], expected["sensor_to_world"], atol=1e-12)
        assert line["num_points"] == expected["num_points"]


def test_without_poses_every_sweep_is_on_its_own(home, tmp_path, capsys):
    lines = stream(home, tmp_path / "boxes.jsonl", "--min-score 0.01")
    assert capsys.readouterr().err.count("no poses: every sweep is detected on its own") == 1
    where = "--checkpoint", home / "checkpoint", "--out", tmp_path / "b.json"
    command("detect", home / "drive", *where, "--min-score 0.01")
    single = json.loads((tmp_path / "b.json").read_text())["files"]
    assert [line["boxes"] for line in lines] == [file["boxes"] for file in single]
    assert {line["timestamp_us"] for line in lines} == {None}


def test_tracks_and_page(home, tmp_path):
    page = tmp_path / "page.html"
    lines = stream(home, tmp_path / "b.jsonl", "--poses", home / "poses.json", "--track --page", page)
    plain = stream(home, tmp_path / "c.jsonl", "--poses", home / "poses.json")
    for line, bare, frame in zip(lines, plain, page_content(page)["frames"], strict=True):
        ids = [box.pop("track") for box in line["boxes"]]
        assert len(set(ids)) == len(ids) > 0
        assert line == bare
        assert frame["ids"] == ids
        assert frame["boxes"] == [box["box"] for box in line["boxes"]]
        assert frame["scores"] == [box["score"] for box in line["boxes"]]


def test_what_came_before_a_bad_cloud_is_written_in_whole_lines(home, tmp_path, capsys):
    for index in range(2):
        np.save(tmp_path / f"{index}.npy", make_frame(index, TINY).points)
    (tmp_path / "2.npy").write_text("nothing")
    out = tmp_path / "boxes.jsonl"
    args = ["stream", str(tmp_path), "--checkpoint", str(home / "checkpoint"), "--out", str(out)]
    assert_one_line_error(capsys, args, "2.npy: not a readable .npy")
    assert [json.loads(line)["file"] for line in out.read_text().splitlines()] == [
        str(tmp_path / f"{index}.npy") for index in range(2)
    ]


def test_an_interruption_leaves_whole_lines(home, tmp_path, monkeypatch):
    def interrupted(*args, **options):
        for number, found in enumerate(detect_stream(*args, **options)):
            yield found
            if number == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(cli_stream, "detect_stream", interrupted)
    out = tmp_path / "boxes.jsonl"
    assert (
        main(["stream", str(home / "drive"), "--checkpoint", str(home / "checkpoint"), "--out", str(out)]) == 130
    )
    assert [set(json.loads(line)) >= {"file", "boxes"} for line in out.read_text().splitlines()] == [True, True]


def test_a_recording_for_rerun(home, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    file = tmp_path / "drive.rrd"
    lines = stream(home, tmp_path / "b.jsonl", "--poses", home / "poses.json", "--rrd", file)
    assert file.read_bytes()[:3] == b"RRF"
    assert len(lines) == SWEEPS


MISTAKES = {
    "time going back": ("HOME/drive --poses HOME/backwards.json", r"1.300000.npy: time: got 1300000 us, expected"),
    "cloud without a pose": ("HOME/drive --poses HOME/short.json", r"short.json: no pose of .*1.400000.npy"),
    "gap": ("HOME/drive --poses HOME/gap.txt", r"gap.txt: .*1.100000.npy: at 1.1 s: a gap in the poses"),
    "poses going back": ("HOME/drive --poses HOME/twice.txt", r"twice.txt: line 2: time: got 1.0 s after 1.0 s"),
    "words": (
        "HOME/drive --poses HOME/words.txt",
        r"words.txt: line 1: got '1 2 3', expected t x y z qx qy qz qw",
    ),
    "no unit": (
        "HOME/drive --poses HOME/long.txt",
        r"long.txt: line 2: rotation: got .* expected a unit quaternion",
    ),
    "no line": ("HOME/drive --poses HOME/none.txt", "none.txt: no pose in it"),
    "no file": ("HOME/drive --poses HOME/nothing.txt", "nothing.txt: no such file"),
    "tracks without poses": ("HOME/drive --track", "--track: found no poses"),
    "no source": ("", "expected either a folder of point files or a recording"),
    "no scene": ("--data-root HOME", "--data-root and --scene together"),
    "keyframes of a folder": ("HOME/drive --keyframes", "--keyframes: expected only with --data-root"),
    "poses of a scene": ("--data-root HOME --scene a --poses HOME/poses.txt", "--poses: expected only with a folder"),
    "no data set": ("--data-root HOME --scene a", "expected"),
    "score": ("HOME/drive --min-score 2", "--min-score: got 2, expected"),
    "angle": ("HOME/drive --yaw-deg nan", "--yaw-deg: got nan, expected an angle"),
    "no folder": ("HOME/nowhere", "nowhere: no such file or folder"),
    "out into a cloud": ("HOME/drive --out HOME/drive/1.000000.npy", "--out: .*the same file as"),
    "out into the checkpoint": (
        "HOME/drive --out HOME/checkpoint/checkpoint.json",
        "--out: .*inside of the checkpoint",
    ),
    "points of a scene": (
        "--data-root HOME --scene a --max-file-points 5",
        "--max-file-points: expected only with a folder or a recording",
    ),
    "links of a folder": ("HOME/drive --follow-links", "--follow-links: expected only with --data-root"),
    "page into poses": (
        "HOME/drive --poses HOME/poses.txt --page HOME/poses.txt",
        "--page: .*the same file as .*poses.txt",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_one_line(home, tmp_path, capsys, case):
    text, message = MISTAKES[case]
    args = ["stream", *text.replace("HOME", str(home)).split(), "--checkpoint", str(home / "checkpoint")]
    out = tmp_path / "boxes.jsonl"
    out.write_text("an earlier result")
    before = {file: file.read_bytes() for file in home.rglob("*") if file.is_file()}
    assert_one_line_error(capsys, args if "--out" in args else [*args, "--out", str(out)], message)
    assert all(file.read_bytes() == content for file, content in before.items())
    # Lost with the first line of the new one.
    assert (out.read_text() == "an earlier result") == (case != "time going back")
