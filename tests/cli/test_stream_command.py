"""``fcos-lidar stream``: the boxes of ``detect --sweeps``, whatever form a drive was recorded in."""

import contextlib
import dataclasses
import json
import re
from unittest.mock import Mock

import numpy as np
import pytest
from commands import assert_one_line_error, command, cut, page_content
from made_argoverse2 import STEP_NS, make_log
from made_bags import structured, write_recording
from scipy.spatial.transform import Rotation
from tiny_run import TINY_CONFIG, save_untrained

from fcos_lidar_jax.cli import main, sinks
from fcos_lidar_jax.cli import stream as cli_stream
from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.sensors import TINY, sensor_to_json
from fcos_lidar_jax.simulation.frames import make_frame

SWEEPS, WINDOW, START_NS, STEP = 5, 3, 1_700_000_000_000_000_000, 100_000_000
TIMES_US = [(START_NS + index * STEP) // 1000 for index in range(SWEEPS)]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A detector of three sweeps, and a drive as a folder with poses in JSON and TUM and as a ROS recording."""
    folder = tmp_path_factory.mktemp("home")
    save_untrained(folder / "checkpoint", dataclasses.replace(TINY_CONFIG, num_sweeps=WINDOW))
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

    write_recording(folder / "mcap", "mcap", content)
    return folder


def stream(home, out, source, *more):
    command("stream", source, "--checkpoint", home / "checkpoint", "--out", out, *more)
    text = out.read_text()
    assert text.endswith("\n")
    return [json.loads(line) for line in text.splitlines()]


def without_file(lines):
    assert len(lines[0]["boxes"]) > 0
    return [{name: value for name, value in line.items() if name != "file"} for line in lines]


@pytest.mark.slow
def test_boxes_equal_detect_with_the_same_sweeps(home, tmp_path, capsys):
    lines = stream(home, tmp_path / "boxes.jsonl", home / "drive", "--poses", home / "poses.json")
    told = capsys.readouterr().err
    assert told.count("compiling the detector") == 1
    assert re.search(r"^5 sweeps in \d+\.\d s, ", told, re.MULTILINE)
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
        fused = listed[max(0, index + 1 - WINDOW) : index + 1]
        assert expected["num_points"] == sum(len(np.load(home / sweep["file"])) for sweep in fused)
        assert {name: line[name] for name in expected if name != "file"} == {
            name: value for name, value in expected.items() if name != "file"
        }
        assert line["timestamp_us"] == listed[index]["timestamp_us"]
        assert line["file"] == str(home / listed[index]["file"])


@pytest.mark.slow
def test_all_forms_of_a_drive_have_the_same_boxes(home, tmp_path):
    """tests/data/test_ros_bags.py reads all forms of recordings."""
    out = tmp_path / "boxes.jsonl"
    expected = without_file(stream(home, out, home / "drive", "--poses", home / "poses.json"))
    assert [line["timestamp_us"] for line in expected] == TIMES_US
    assert without_file(stream(home, out, home / "drive", "--poses", home / "poses.txt")) == expected
    for how in ("/odom", "tf --topic /points"):
        lines = stream(home, out, home / "mcap", f"--odometry {how}")
        assert without_file(lines) == expected, how
        assert lines[2]["file"] == f"{home}/mcap: /points: message 2"


@pytest.mark.slow
def test_keyframes_skip_the_boxes_of_other_sweeps_and_are_called_by_their_tokens(home, tmp_path, capsys):
    (tmp_path / "sensor.json").write_text(json.dumps(sensor_to_json(TINY)))
    data = f"--data-root {tmp_path}/data --scene {{scene}} --checkpoint {home}/checkpoint"
    command(f"synthesize --out {tmp_path}/data --scenes 1 --keyframes 3 --sensor {tmp_path}/sensor.json")
    [scenes] = (tmp_path / "data").glob("*/scene.json")
    data = data.format(scene=json.loads(scenes.read_text())[0]["name"])
    command("stream", data, "--out", tmp_path / "all.jsonl")
    capsys.readouterr()
    command("stream", data, "--keyframes --out", tmp_path / "some.jsonl")
    told = capsys.readouterr().err
    assert "3 sweeps in " in told
    assert re.search(r"^sweeps 1  \S+: \d+ boxes$", told, re.MULTILINE)
    every, some = (tmp_path / f"{name}.jsonl" for name in ("all", "some"))
    lines = some.read_text().splitlines()
    assert len(lines) == 3
    assert set(lines) < set(every.read_text().splitlines())
    command("stream", data, "--keyframes --output-format nuscenes --out", tmp_path / "results.json")
    samples = json.loads(scenes.with_name("sample.json").read_text())
    by_time = [sample["token"] for sample in sorted(samples, key=lambda sample: sample["timestamp"])]
    assert list(json.loads((tmp_path / "results.json").read_text())["results"]) == by_time


def test_without_poses_every_sweep_is_detected_on_its_own(home, tmp_path, capsys):
    lines = stream(home, tmp_path / "boxes.jsonl", home / "drive", "--min-score 0.01")
    assert capsys.readouterr().err.count("no poses: every sweep is detected on its own") == 1
    where = "--checkpoint", home / "checkpoint", "--out", tmp_path / "b.json"
    command("detect", home / "drive", *where, "--min-score 0.01")
    single = json.loads((tmp_path / "b.json").read_text())["files"]
    assert [line["boxes"] for line in lines] == [file["boxes"] for file in single]
    assert {line["timestamp_us"] for line in lines} == {None}
    recorded = stream(home, tmp_path / "a.jsonl", home / "mcap")  # whose times are known
    assert [(line["timestamp_us"], line["sensor_to_world"]) for line in recorded] == [(t, None) for t in TIMES_US]
    stream(home, tmp_path / "a.jsonl", home / "mcap", "--page", page := tmp_path / "page.html")
    assert [frame["time_us"] for frame in page_content(page)["frames"]] == TIMES_US
    command("detect", home / "mcap", *where)
    assert json.loads((tmp_path / "b.json").read_text()) == {"files": recorded}


def test_tracks_and_page(home, tmp_path, capsys, monkeypatch):
    page = tmp_path / "page.html"
    lines = stream(
        home, tmp_path / "b.jsonl", home / "drive", "--poses", home / "poses.json", "--track --page", page
    )
    monkeypatch.setattr(sinks, "_LARGEST_PAGE", 1)
    short = home / "drive", "--poses", home / "poses.json", "--page", tmp_path / "short.html"
    plain = stream(home, tmp_path / "c.jsonl", *short)
    assert len(page_content(short[-1])["frames"]) == 1
    assert "--page ends after 1 clouds: browsers" in capsys.readouterr().err
    for line, bare, frame in zip(lines, plain, page_content(page)["frames"], strict=True):
        ids = [box.pop("track") for box in line["boxes"]]
        assert len(set(ids)) == len(ids) > 0
        assert line == bare
        rows = [ids.index(each) for each in frame["ids"]]  # a page has one box per object
        assert rows == sorted(rows) != []
        assert frame["boxes"] == [line["boxes"][row]["box"] for row in rows]
        assert frame["scores"] == [line["boxes"][row]["score"] for row in rows]


def test_only_confident_boxes_are_tracked_by_default(home, tmp_path, monkeypatch):
    posed = home / "drive", "--poses", home / "poses.json"
    scores = [box["score"] for line in stream(home, tmp_path / "a.jsonl", *posed) for box in line["boxes"]]
    monkeypatch.setattr(cli_stream, "_TRACKED_SCORE", middle := float(np.median(scores)))
    tracked, every = (
        stream(home, tmp_path / "b.jsonl", *posed, more) for more in ("--track", "--track --min-score 0")
    )
    kept, whole = ([box["score"] for line in lines for box in line["boxes"]] for lines in (tracked, every))
    assert kept == [score for score in scores if score >= middle]
    assert whole == scores != kept


def test_all_outputs_have_the_sweeps_before_an_invalid_cloud(home, tmp_path, capsys, monkeypatch):
    for index in range(2):
        np.save(tmp_path / f"{index}.npy", make_frame(index, TINY).points)
    (tmp_path / "2.npy").write_text("nothing")
    recorded = []

    @contextlib.contextmanager
    def recording(path, classes, *, min_score):
        yield (record := Mock())
        recorded.append(record.call_count)

    monkeypatch.setattr("fcos_lidar_jax.cli.sinks.rerun_recording", recording)
    monkeypatch.setattr("fcos_lidar_jax.cli.checks.import_extra", Mock())
    out, page = tmp_path / "boxes.jsonl", tmp_path / "page.html"
    views = ["--page", str(page), "--rrd", str(tmp_path / "a.rrd")]
    args = ["stream", str(tmp_path), "--checkpoint", str(home / "checkpoint"), *views, "--out", str(out)]
    for more in ([], ["--output-format", "openlabel"]):
        assert main([*args, *more]) == 1
        *_, told, error = capsys.readouterr().err.splitlines()
        assert told == "the outputs have the 2 sweeps before the failure"
        assert "2.npy: not a readable .npy" in error
        assert len(page_content(page)["frames"]) == recorded.pop() == 2
        if not more:
            names = [json.loads(line)["file"] for line in out.read_text().splitlines()]
            assert names == [str(tmp_path / f"{index}.npy") for index in range(2)]
    assert list(json.loads(out.read_text())["openlabel"]["frames"]) == ["0", "1"]


def test_empty_sweeps_have_no_boxes_and_are_counted(home, tmp_path, capsys):
    points = make_frame(0, TINY).points
    for index, number in enumerate((0, 9999)):
        np.save(tmp_path / f"{index}.npy", points[:number])
    lines = stream(home, tmp_path / "boxes.jsonl", tmp_path)
    assert [len(line["boxes"]) > 0 for line in lines] == [False, True]
    assert "note: 1 of 2 clouds without usable points, and so without boxes: " in capsys.readouterr().err
    (tmp_path / "1.npy").unlink()
    args = ["stream", str(tmp_path), "--checkpoint", str(home / "checkpoint"), "--output-format", "openlabel"]
    message = "0.npy: no points in it, expected at least one$"
    assert_one_line_error(capsys, [*args, "--out", str(tmp_path / "labels.json")], message)
    assert not (tmp_path / "labels.json").exists()


def test_sweeps_out_of_order_are_kept_without_poses_and_skipped_with_them(home, tmp_path, capsys):
    """A note tells them, also if a later sweep cannot be read."""
    cloud, times = structured(make_frame(0, TINY).points), [5000, 4000, 0, 5000, 6000]
    out, note = tmp_path / "a.jsonl", "note: sweeps that are not later than all before: {}, the first is {}; {}"
    for more in ([], [("/p", 7000, np.tile(cloud, 2))]):
        content = [("/p", time, cloud) for time in times] + more
        bag = write_recording(
            tmp_path / f"{len(more)}", "sqlite", lambda make, c=content: ((p, make.cloud(t, x)) for p, t, x in c)
        )
        args = ["stream", bag, "--checkpoint", home / "checkpoint", "--max-file-points", len(cloud), "--out", out]
        assert main([*map(str, args)]) == len(more)
        lines = [json.loads(text) for text in out.read_text().splitlines()]
        assert [line["timestamp_us"] for line in lines] == [5, 4, 0, 5, 6]
        assert all(line["boxes"] == lines[0]["boxes"] for line in lines)
        assert capsys.readouterr().err.count(note.format(3, f"{bag}: /p: message 1", "kept")) == 1
    listed = json.loads((home / "poses.json").read_text())
    listed.insert(1, listed.pop(2))
    (home / "jump.json").write_text(json.dumps(listed))
    for more in ("", "--track"):
        found = stream(home, tmp_path / "b.jsonl", home / "drive", "--poses", home / "jump.json", more)
        assert [line["timestamp_us"] for line in found] == [TIMES_US[i] for i in (0, 2, 3, 4)]
        assert note.format(1, home / listed[2]["file"], "skipped") in capsys.readouterr().err


def test_a_log_of_argoverse2_is_a_source(home, tmp_path, capsys):
    log = make_log(tmp_path / "log", 0, sweeps=4, sensor=dataclasses.replace(TINY, row_source="laser"))
    lines = stream(home, tmp_path / "a.jsonl", log)
    frames = Argoverse2Frames(log)
    assert [line["timestamp_us"] for line in lines] == [frames.time_us(i) for i in range(4)]
    assert np.diff([line["timestamp_us"] for line in lines]).tolist() == [STEP_NS // 1000] * 3
    for index, line in enumerate(lines):
        assert line["sensor_to_world"] == frames.pose(index).tolist()
    command("detect", log, "--checkpoint", home / "checkpoint", "--out", tmp_path / "a.json")
    found = (tmp_path / "a.json").read_text()
    assert json.loads(found) == {"files": lines}
    cut(sorted((log / "sensors" / "lidar").iterdir())[2], 100)
    args = ["detect", str(log), "--checkpoint", str(home / "checkpoint"), "--out", str(tmp_path / "a.json")]
    assert_one_line_error(capsys, args, "feather: not a readable .feather file: ")
    assert (tmp_path / "a.json").read_text() == found
