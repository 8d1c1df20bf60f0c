"""The command line as a user meets it: good runs, and one line for every mistake."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from commands import assert_one_line_error, command, page_content
from PIL import Image
from tiny_run import TINY_CONFIG, bits, untrained

from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import demo, main
from fcos_lidar_jax.cli import detect as detect_command
from fcos_lidar_jax.files import file_lock
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with an untrained checkpoint, a damaged and a foreign one, and clouds good and bad."""
    folder = tmp_path_factory.mktemp("home")
    checkpoint = Checkpoint(TINY_CONFIG, TINY, untrained(TINY_CONFIG, TINY), 7)
    save_checkpoint(folder / "checkpoint", checkpoint)
    wide = dataclasses.replace(TINY_CONFIG, model=dataclasses.replace(TINY_CONFIG.model, fpn_channels=48))
    save_checkpoint(folder / "foreign", dataclasses.replace(checkpoint, config=wide))
    shutil.copytree(folder / "checkpoint", folder / "damaged")
    for file in (folder / "damaged" / "variables").rglob("*"):
        if file.is_file() and file.stat().st_size > 1000:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    record = json.loads((folder / "checkpoint" / "checkpoint.json").read_text())
    record["config"]["model"]["fpn_channels"] = "wide"
    for name, text in (("garbled", "{"), ("old", '{"format": 0}'), ("fields", json.dumps(record))):
        shutil.copytree(folder / "checkpoint", folder / name)
        (folder / name / "checkpoint.json").write_text(text)
    points = make_frame(0, TINY).points
    np.save(folder / "good.npy", points)
    points[11, 1] = np.nan
    np.save(folder / "nan.npy", points)
    np.save(folder / "away.npy", points + np.array([500, 500, 0, 0, 0], np.float32))
    np.save(folder / "all_nan.npy", np.full((5, 5), np.nan, np.float32))
    np.save(folder / "pickled.npy", np.array([{"a": 1}], object), allow_pickle=True)
    np.save(folder / "flat.npy", np.zeros(4, np.float32))
    np.save(folder / "future.npy", np.full((4, 5), -1.0, np.float32))
    (folder / "nothing").mkdir()
    (folder / "link.json").symlink_to("good.npy")
    (folder / "empty.bin").write_bytes(b"")
    (folder / "cut.pcd.bin").write_bytes(points.tobytes()[:-3])
    (folder / "text.txt").write_text("1 2 3")
    (folder / "broken.pcd").write_text("no header")
    (folder / "sensor.json").write_text('{"name": "x", "num_columns": "many"}')
    return folder


def test_detect_writes_the_contract(home, tmp_path, capsys):
    out, files = tmp_path / "boxes.json", [home / "good.npy", home / "nan.npy"]
    look = "--pictures", tmp_path, "--page", tmp_path / "page.html"
    command("detect", *files, "--checkpoint", home / "checkpoint", "--out", out, *look)
    progress = capsys.readouterr().err.strip().splitlines()
    assert len(progress) == 2
    assert "2/2" in progress[1]
    good, bad = json.loads(out.read_text())["files"]
    assert good["file"] == str(files[0])
    assert good["num_points"] == len(np.load(files[0])) == bad["num_points"]
    assert bad["num_dropped"] == good["num_dropped"] + 1
    for box in good["boxes"]:
        assert set(box) == {"label", "score", "box"}
        assert box["label"] in NUSCENES_CLASSES
        assert 0 < box["score"] <= 1
        assert len(box["box"]) == 9
        assert -np.pi <= box["box"][6] < np.pi
    scores = [box["score"] for box in good["boxes"]]
    assert len(scores) > 0
    assert scores == sorted(scores, reverse=True)
    assert len(list(tmp_path.glob("*.png"))) == 2
    for file, frame in zip((good, bad), page_content(tmp_path / "page.html")["frames"], strict=True):
        assert frame["name"] == Path(file["file"]).name
        assert frame["boxes"] == [box["box"] for box in file["boxes"]]
        assert [frame["pose"], frame["truth"]] == [None, None]


def test_detect_turns_clouds_for_the_detector_and_boxes_back(home, tmp_path):
    cloud = np.load(home / "good.npy")
    np.save(tmp_path / "ahead.npy", np.column_stack([cloud[:, 1], -cloud[:, 0], cloud[:, 2:]]))  # x ahead
    checkpoint, page = ("--checkpoint", home / "checkpoint"), tmp_path / "page.html"
    command("detect", home / "good.npy", *checkpoint, "--out", tmp_path / "a.json")
    command(
        "detect", tmp_path / "ahead.npy", *checkpoint, "--yaw-deg 90 --out", tmp_path / "b.json", "--page", page
    )
    right, ahead = (json.loads((tmp_path / f"{name}.json").read_text())["files"][0]["boxes"] for name in "ab")
    assert len(right) == len(ahead) > 0
    for one, other in zip(right, ahead, strict=True):
        assert one["label"] == other["label"]
        assert one["score"] == pytest.approx(other["score"], abs=1e-4)
        x, y, z, length, width, height, yaw, vx, vy = one["box"]
        expected = [y, -x, z, length, width, height, yaw - np.pi / 2, vy, -vx]
        found = np.array(other["box"])
        found[6] += 2 * np.pi * round((expected[6] - found[6]) / (2 * np.pi))
        np.testing.assert_allclose(found, expected, atol=2e-3)
    [frame] = page_content(page)["frames"]
    assert frame["boxes"] == [box["box"] for box in ahead]


@pytest.mark.parametrize("look", [[], ["--page", "page.html", "--pictures", "pictures"]], ids=["plain", "look"])
def test_a_stopped_detect_resumes(home, tmp_path, capsys, monkeypatch, look):
    """What is done is not detected again; another option, or another file of that name, is."""
    monkeypatch.chdir(tmp_path)
    clouds = [shutil.copy(home / "good.npy", tmp_path / f"{name}.npy") for name in "abcd"]
    detect = ["detect", *clouds, "--checkpoint", home / "checkpoint", *look]
    command(*detect, "--out whole.json")
    shutil.move(clouds[3], tmp_path / "away.npy")
    capsys.readouterr()
    assert_one_line_error(capsys, [*map(str, detect), "--out", "boxes.json"], "d.npy: no such file")
    assert not (tmp_path / "boxes.json").exists()
    log = tmp_path / ".boxes.json.resume_log"
    done = len(log.read_text().splitlines()) - 1
    assert 1 <= done <= 3
    # A mistake with other options, which begins no log of its own, loses nothing.
    other = "--min-score", "0.5", "--out", "boxes.json"
    assert_one_line_error(capsys, ["detect", "d.npy", "--checkpoint", str(home / "checkpoint"), *other], "no such")
    assert len(log.read_text().splitlines()) == 1 + done
    shutil.move(tmp_path / "away.npy", clouds[3])
    monkeypatch.setattr(detect_command, "predict", predicted := Mock(wraps=detect_command.predict))
    command(*detect, "--out boxes.json")
    assert f"{done}/4  detected before" in capsys.readouterr().err
    assert predicted.call_args.kwargs["indices"] == list(range(done, 4))
    assert (tmp_path / "boxes.json").read_bytes() == (tmp_path / "whole.json").read_bytes()
    assert not log.exists()
    if look:
        page = page_content(tmp_path / "page.html")
        assert [frame["name"] for frame in page["frames"]] == ["a.npy", "b.npy", "c.npy", "d.npy"]
        assert page["score"] == 0.3
        assert len(list((tmp_path / "pictures").iterdir())) == 4


def test_a_resumed_detect_draws_what_has_no_picture(home, tmp_path, capsys):
    for name in "abc":
        shutil.copy(home / "good.npy", tmp_path / f"{name}.npy")
    options = (
        "--checkpoint",
        home / "checkpoint",
        "--out",
        tmp_path / "x.json",
        "--pictures",
        tmp_path / "pictures",
    )
    files = [tmp_path / f"{name}.npy" for name in "abc"]
    assert_one_line_error(capsys, [*map(str, ["detect", *files, tmp_path / "d.npy", *options])], "d.npy: no such")
    shutil.rmtree(tmp_path / "pictures")
    command("detect", *files, *options, "--min-score 0 --page", tmp_path / "page.html")
    names = sorted(picture.name for picture in (tmp_path / "pictures").iterdir())
    assert names == ["0001_a.npy.png", "0002_b.npy.png", "0003_c.npy.png"]


@pytest.mark.parametrize("name", ["x.resume_log", "x", "x.json"])
def test_any_name_will_do_for_the_boxes(home, tmp_path, name):
    command("detect", home / "good.npy", "--checkpoint", home / "checkpoint", "--out", tmp_path / name)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert len(json.loads((tmp_path / name).read_text())["files"]) == 1


def test_a_page_shows_at_first_what_was_asked_for(home, tmp_path):
    page = tmp_path / "page.html"
    options = "--min-score 0.25 --page", page, "--out", tmp_path / "x.json"
    command("detect", home / "good.npy", "--checkpoint", home / "checkpoint", *options)
    assert page_content(page)["score"] == 0.25


@pytest.mark.parametrize("other", [["--min-score", "0.3"], ["--yaw-deg", "90"], ["--remove-close", "none"], []])
def test_detect_resumes_only_what_would_be_the_same(home, tmp_path, capsys, other):
    clouds = [shutil.copy(home / "good.npy", tmp_path / f"{name}.npy") for name in "abc"]
    words = [
        "detect",
        *clouds,
        tmp_path / "d.npy",
        "--checkpoint",
        home / "checkpoint",
        "--out",
        tmp_path / "x.json",
    ]
    assert_one_line_error(capsys, [*map(str, words)], "d.npy: no such file")
    if not other:
        for cloud in clouds:
            shutil.copy(home / "nan.npy", cloud)
    words.remove(tmp_path / "d.npy")
    command(*words, *other)
    assert "detected before" not in capsys.readouterr().err
    dropped = {file["num_dropped"] for file in json.loads((tmp_path / "x.json").read_text())["files"]}
    assert len(dropped) == 1


def test_two_detections_into_a_file_are_refused(home, tmp_path, capsys):
    with file_lock(tmp_path / ".x.json.resume_log"):
        words = ["detect", home / "good.npy", "--checkpoint", home / "checkpoint", "--out", tmp_path / "x.json"]
        assert_one_line_error(capsys, [*map(str, words)], "x.json: in use: another process is detecting")


def test_a_file_name_is_no_formula(home, tmp_path):
    """Nor need it be text."""
    cloud = tmp_path / os.fsdecode(b"$\\frac{a$\xff.npy")
    shutil.copy(home / "good.npy", cloud)
    where = ["--out", tmp_path / "a.json", "--pictures", tmp_path / "pictures"]
    command("detect", cloud, "--checkpoint", home / "checkpoint", *where)
    assert json.loads((tmp_path / "a.json").read_text())["files"][0]["file"] == str(cloud)
    assert len(list((tmp_path / "pictures").iterdir())) == 1
    command("project", cloud, "--sensor tiny --out", tmp_path / "a.npz", "--png", tmp_path / "a.png")


def test_detect_fuses_sweeps(home, tmp_path):
    sweep = {"file": str(home / "good.npy"), "sensor_to_world": np.eye(4).tolist()}
    out, sweeps = tmp_path / "boxes.json", tmp_path / "sweeps.json"
    sweeps.write_text(json.dumps([{**sweep, "timestamp_us": 10**6 - i} for i in range(3)]))
    several = dataclasses.replace(TINY_CONFIG, num_sweeps=2)
    save_checkpoint(tmp_path / "several", Checkpoint(several, TINY, untrained(several, TINY), 7))
    command("detect --sweeps", sweeps, "--checkpoint", tmp_path / "several", "--out", out)
    [result] = json.loads(out.read_text())["files"]
    points = np.load(home / "good.npy")
    close = (np.abs(points[:, :2]) < 1).all(axis=1).sum()
    assert result["num_points"] == 2 * len(points)
    assert result["num_close"] == 2 * close > 0


def test_project_writes_index_features_counts_and_picture(home, tmp_path, capsys):
    out, png = tmp_path / "image.npz", tmp_path / "image.png"
    command("project", home / "nan.npy", "--out", out, "--png", png, "--sensor tiny")
    counts = json.loads(capsys.readouterr().out)
    points = np.load(home / "nan.npy")
    with np.load(out) as image:
        index, features = image["point_index"], image["features"]
        assert image["num_dropped"] == counts["num_dropped"] >= 1
        assert image["num_points"] == len(points)
    assert index.shape == (16, 256, 5)
    assert features.shape == (16, 256, 9, 5)
    filled = index >= 0
    np.testing.assert_array_equal(features[:, :, 0][filled], points[index[filled], 0])
    assert 11 not in index
    assert counts["kept_by_round"] == filled.sum((0, 1)).tolist()
    assert png.stat().st_size > 10_000


# Each with "--checkpoint HOME/checkpoint" for detect and "--out OUT" unless it says otherwise.
BAD = {
    "missing file": ("detect HOME/none.npy", "none.npy: no such file"),
    "folder without clouds": ("detect HOME/nothing", "nothing: no point file in it"),
    "empty file": ("detect HOME/empty.bin", "empty.bin: empty file"),
    "truncated file": ("detect HOME/cut.pcd.bin", "cut.pcd.bin: .* not a multiple of 20"),
    "angle": ("detect HOME/good.npy --yaw-deg nan", "--yaw-deg: got nan, expected an angle in degrees"),
    "unknown extension": ("detect HOME/text.txt", "unknown extension '.txt'"),
    "pickled array": ("detect HOME/pickled.npy", "pickled.npy: not a readable .npy"),
    "one axis": ("detect HOME/flat.npy", "flat.npy: shape"),
    "negative lag": ("detect HOME/future.npy", "future.npy: time_lag"),
    "broken pcd": ("detect HOME/broken.pcd", "broken.pcd: not a PCD file"),
    "out of range": ("detect HOME/away.npy", "away.npy: none of its .* points is usable"),
    "nothing finite": ("detect HOME/all_nan.npy", r"all_nan.npy: none .*\(5 not finite"),
    "good then bad": ("detect HOME/good.npy HOME/none.npy", "none.npy: no such file"),
    "no input": ("detect", "expected either point files or --sweeps"),
    "bad columns": ("detect HOME/empty.bin --columns 9", "columns: got 9"),
    "columns of npy": ("detect HOME/good.npy --columns 5", "are for raw .bin files"),
    "list of sweeps": ("detect HOME/s.json", "s.json: expected a point file, or --sweeps before a list of sweeps"),
    "sweeps of no list": ("detect --sweeps HOME/good.npy", "good.npy: expected a file that ends in .json"),
    "page on the log": (
        "detect HOME/good.npy --out OUT --page OUT/../.out.resume_log",
        "--page: .*the same file as",
    ),
    "missing sweeps": ("detect --sweeps HOME/s.json", "s.json: no such file"),
    "no checkpoint": (
        "detect HOME/good.npy --checkpoint HOME/none",
        "none: found nothing, expected a checkpoint folder",
    ),
    "file for a checkpoint": (
        "detect HOME/good.npy --checkpoint HOME/good.npy",
        "found a file, expected a checkpoint folder",
    ),
    "folder without checkpoint": ("detect HOME/good.npy --checkpoint HOME", "no checkpoint.json in it"),
    "checkpoint of another preset": (
        "detect HOME/good.npy --checkpoint HOME/foreign",
        r"foreign: params/.*: got \(.*\), expected \(.*\): the arrays are not",
    ),
    "damaged checkpoint": ("detect HOME/good.npy --checkpoint HOME/damaged", "damaged.*: damaged"),
    "garbled description": ("detect HOME/good.npy --checkpoint HOME/garbled", "checkpoint.json: not JSON"),
    "old format": ("detect HOME/good.npy --checkpoint HOME/old", "format: got 0, expected 3"),
    "bad field": (
        "detect HOME/good.npy --checkpoint HOME/fields",
        "fields/checkpoint.json: not as it was written",
    ),
    "project missing": ("project HOME/none.bin", "none.bin: no such file"),
    "project sensor": ("project HOME/good.npy --sensor sonar", "sonar: no such sensor"),
    "project sensor file": ("project HOME/good.npy --sensor HOME/sensor.json", "sensor.json: .*: "),
    "project rounds": ("project HOME/good.npy --rounds 0", "--rounds: got 0"),
    "project away": ("project HOME/away.npy", "away.npy: none of its"),
    "project laser": ("project HOME/good.npy --sensor argoverse2", "good.npy: no laser number"),
    "project into a folder": ("project HOME/good.npy --out HOME", "found a folder"),
    "detect into its input": ("detect HOME/good.npy --out HOME/good.npy", "--out: .*the same file as .*good.npy"),
    "detect into its input by a link": ("detect HOME/good.npy --out HOME/link.json", "--out: .*the same file as"),
    "detect into another link": ("detect HOME/none.npy --out HOME/link.json", "link.json: found a link to .*good"),
    "detect into a device": ("detect HOME/none.npy --out /dev/null", "/dev/null: found a device or a pipe"),
    "detect into a checkpoint": (
        "detect HOME/none.npy --out HOME/checkpoint/boxes.json",
        "--out: .*inside of the checkpoint",
    ),
    "pictures into a checkpoint": (
        "detect HOME/none.npy --pictures HOME/checkpoint/pictures",
        "--pictures: .*inside of the checkpoint",
    ),
    "synthesize for laser numbers": (
        "synthesize --scenes 1 --sensor argoverse2",
        "--sensor: got argoverse2, whose rows come from laser numbers",
    ),
    "detect below a file": (
        "detect HOME/none.npy --out HOME/good.npy/x",
        "good.npy: found a file, expected a fol",
    ),
    "pictures in a file": (
        "detect HOME/none.npy --pictures HOME/good.npy",
        "--pictures: .*: found a file, expect",
    ),
    "score beyond one": ("detect HOME/good.npy --min-score 50", "--min-score: got 50, expected a score of 0 to 1"),
    "score that is none": ("detect HOME/good.npy --min-score nan", "--min-score: got nan, expected a score"),
    "too many points": ("detect HOME/good.npy --max-file-points 10", r"good.npy: .*points, expected at most 10$"),
    "picture into the image": (
        "project HOME/good.npy --out OUT --png OUT",
        "--png: .*out: the same file as .*out",
    ),
    "picture into the input": ("project HOME/good.npy --png HOME/good.npy", "--png: .*the same file as"),
    "project too many points": ("project HOME/good.npy --max-file-points 10", "points, expected at most 10$"),
    "demo into a file": ("demo --out HOME/good.npy", "--out: .*: found a file"),
    "demo with fewer than no steps": ("demo --steps -1", "--steps: got -1"),
    "demo of steps without training": ("demo --steps 5", "--steps: expected --train with it"),
    "demo without a keyframe": ("demo --keyframes 0", "--keyframes: got 0"),
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes_get_one_line_and_leave_nothing(home, tmp_path, capsys, name):
    line, message = BAD[name]
    line += "" if "--out" in line else " --out OUT"
    line += " --checkpoint HOME/checkpoint" if line.startswith("detect") and "--checkpoint" not in line else ""
    args = line.replace("HOME", str(home)).replace("OUT", str(tmp_path / "out")).split()
    assert_one_line_error(capsys, args, message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("line", ["detct", "detect --checkpiont x", "project", "demo --steps many"])
def test_usage_errors_exit_with_2(line):
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    assert stopped.value.code == 2


def test_usage_error_names_the_nearest_option(capsys):
    with pytest.raises(SystemExit):
        main(["detect", "x.npy", "--out", "a", "--chekpoint", "b"])
    shown = capsys.readouterr()
    assert "--checkpoint" in shown.err + shown.out


@pytest.mark.parametrize(
    "name", ["demo", "synthesize", "train", "evaluate", "detect", "export", "benchmark", "project"]
)
def test_help_explains(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert stopped.value.code == 0
    assert "--out" in capsys.readouterr().out


@pytest.fixture(scope="module")
def drive(home):
    """The demo's results for a network that compiles in seconds; three keyframes, and two steps of training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "WEIGHTS", str(home / "checkpoint"))
        command("demo --keyframes 3 --train --steps 2 --test-frames 3 --out", home / "demo")
    return home / "demo"


def test_demo_writes_the_benchmarks_numbers_of_its_drive(drive, home, tmp_path):
    """Those that ``evaluate`` finds in the data set that it leaves."""
    place = ["--data-root", drive / "drive", "--split", "train", "--checkpoint", home / "checkpoint"]
    command("evaluate --no-report --out", tmp_path / "evaluation", *place)
    ours, again = (
        json.loads((folder / "metrics_summary.json").read_text()) for folder in (drive, tmp_path / "evaluation")
    )
    assert ours.pop("eval_time") > 0 < again.pop("eval_time")
    assert ours["cfg"]["max_boxes_per_sample"] == 500
    assert json.dumps(ours) == json.dumps(again)
    assert set(json.loads((drive / "bootstrap.json").read_text())) >= {"mean_ap", "nd_score", "level"}


def test_demo_draws_an_animation_and_reports(drive):
    with Image.open(drive / "drive.gif") as animation:
        assert (animation.n_frames, animation.info["loop"]) == (3, 0)
        for i in range(3):
            with Image.open(drive / f"drive_{i:02d}.png") as picture:
                assert picture.size == animation.size
    report = (drive / "report.html").read_text()
    assert report.count("data:image/gif;base64,") == 1
    assert "NDS" in report
    assert 'href="drive.html"' in report
    frames = page_content(drive / "drive.html")["frames"]
    assert [frame["time_us"] - frames[0]["time_us"] for frame in frames] == pytest.approx([0, 5e5, 1e6], abs=1e5)
    assert all(frame["pose"] and frame["num_points"] > 500 for frame in frames)
    assert sum(len(frame["truth"]) for frame in frames) > 0
    assert "://" not in report  # no outside address; base64 has no colon


def test_demo_trains_from_nothing_to_report(drive, tmp_path):
    out, boxes = drive / "training", tmp_path / "boxes.json"
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["training"]["steps"] == 2
    for model in ("shipped", "before", "after"):
        assert {*metrics[model]["label_aps"], *metrics[model]["absent_classes"]} == set(QUICKSTART.classes)
    report = (out / "report.html").read_text()
    assert report.count("data:image/png;base64,") == 9
    assert "://" not in report  # no outside address; base64 has no colon
    unseen = out / "unseen" / "frame_000.npy"
    command("detect", unseen, "--checkpoint", out / "run", "--out", boxes)
    assert json.loads(boxes.read_text())["files"][0]["num_points"] == len(np.load(unseen))


def test_a_checkpoint_takes_the_place_of_another_whole(home, tmp_path):
    first = load_checkpoint(home / "checkpoint")
    save_checkpoint(tmp_path / "c", first)
    doubled = jax.tree.map(lambda leaf: leaf * 2, first.variables)
    save_checkpoint(tmp_path / "c", dataclasses.replace(first, variables=doubled, step=8))
    again = load_checkpoint(tmp_path / "c")
    assert (again.step, bits(again.variables)) == (8, bits(doubled))
    assert [p.name for p in tmp_path.iterdir()] == ["c"]
