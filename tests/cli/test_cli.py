"""The commands ``detect``, ``project`` and ``demo``: their results, and one line per mistake in any command."""

import dataclasses
import json
import os
import re
import shutil
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from commands import assert_one_line_error, command, mistakes, page_content
from made_kitti import make_kitti
from PIL import Image
from tiny_run import TINY_CONFIG, bits, untrained

from fcos_lidar_jax import __version__
from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import demo, main
from fcos_lidar_jax.cli import detect as detect_command
from fcos_lidar_jax.cli.commands import _COMMANDS
from fcos_lidar_jax.files import file_lock
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with valid and invalid checkpoints, clouds and sensors; the detector is untrained."""
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
    np.save(folder / "no_rows.npy", points[:0])
    np.save(folder / "all_nan.npy", np.full((5, 5), np.nan, np.float32))
    np.save(folder / "pickled.npy", np.array([{"a": 1}], object), allow_pickle=True)
    np.save(folder / "flat.npy", np.zeros(4, np.float32))
    np.save(folder / "future.npy", np.full((4, 5), -1.0, np.float32))
    np.save(folder / "scaled_ring.npy", np.column_stack([points[:, :4], np.arange(len(points)) % 16 / 15]))
    (folder / "nothing").mkdir()
    (folder / "link.json").symlink_to("good.npy")
    (folder / "empty.bin").write_bytes(b"")
    (folder / "cut.pcd.bin").write_bytes(points.tobytes()[:-3])
    (folder / "text.txt").write_text("1 2 3")
    (folder / "broken.pcd").write_text("no header")
    (folder / "sensor.json").write_text('{"name": "x", "num_columns": "many"}')
    return folder


def detect(home, *words):
    """The arguments of ``detect`` with the detector of ``home``."""
    return ["detect", *map(str, words), "--checkpoint", str(home / "checkpoint")]


def files_of(out):
    return json.loads(out.read_text())["files"]


def test_detect_writes_boxes_pictures_and_a_page(home, tmp_path, capsys):
    out, clouds, page = tmp_path / "boxes.json", [home / "good.npy", home / "nan.npy"], tmp_path / "page.html"
    command(*detect(home, *clouds, "--out", out, "--pictures", tmp_path, "--page", page))
    note, *progress = capsys.readouterr().err.strip().splitlines()
    assert note.startswith("note: the heading of the clouds is not declared")
    assert len(progress) == 2
    assert "2/2" in progress[1]
    good, bad = files_of(out)
    assert good["file"] == str(clouds[0])
    assert good["num_points"] == len(np.load(clouds[0])) == bad["num_points"]
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
    for file, frame in zip((good, bad), page_content(page)["frames"], strict=True):
        assert frame["name"] == Path(file["file"]).name
        assert frame["boxes"] == [box["box"] for box in file["boxes"]]
        assert [frame["pose"], frame["truth"]] == [None, None]


def test_detect_turns_clouds_for_the_detector_and_boxes_back(home, tmp_path):
    cloud = np.load(home / "good.npy")
    np.save(tmp_path / "ahead.npy", np.column_stack([cloud[:, 1], -cloud[:, 0], cloud[:, 2:]]))  # x forward
    page = tmp_path / "page.html"
    command(*detect(home, home / "good.npy", "--out", tmp_path / "a.json"))
    command(*detect(home, tmp_path / "ahead.npy", "--out", tmp_path / "b.json"), "--yaw-deg 90 --page", page)
    right, ahead = (files_of(tmp_path / f"{name}.json")[0]["boxes"] for name in "ab")
    assert len(right) == len(ahead) > 0
    for a, b in zip(right, ahead, strict=True):
        assert a["label"] == b["label"]
        assert a["score"] == pytest.approx(b["score"], abs=1e-4)
        x, y, z, length, width, height, yaw, vx, vy = a["box"]
        expected = [y, -x, z, length, width, height, yaw - np.pi / 2, vy, -vx]
        box = np.array(b["box"])
        box[6] += 2 * np.pi * round((expected[6] - box[6]) / (2 * np.pi))
        np.testing.assert_allclose(box, expected, atol=2e-3)
    [frame] = page_content(page)["frames"]
    assert frame["boxes"] == [box["box"] for box in ahead]


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--page", "page.html", "--pictures", "pictures"]], ids=["plain", "drawn"])
def test_an_interrupted_detect_resumes(home, tmp_path, capsys, monkeypatch, more):
    monkeypatch.chdir(tmp_path)
    clouds = [shutil.copy(home / "good.npy", tmp_path / f"{name}.npy") for name in "abcd"]
    words = detect(home, *clouds, *more)
    command(*words, "--out whole.json")
    shutil.move(clouds[3], tmp_path / "away.npy")
    if more:
        shutil.rmtree("pictures")
    assert_one_line_error(capsys, [*words, "--out", "boxes.json"], "d.npy: no such file")
    assert not (tmp_path / "boxes.json").exists()
    log = tmp_path / ".boxes.json.resume_log"

    def finished():
        return sum(not line.startswith('"picture ') for line in log.read_text().splitlines()) - 1

    done = finished()
    assert 1 <= done <= 3
    # A mistake with other options before their first result loses nothing.
    other = "--min-score", "0.5", "--out", "boxes.json"
    assert_one_line_error(capsys, detect(home, "d.npy", *other), "no such")
    assert finished() == done
    shutil.move(tmp_path / "away.npy", clouds[3])
    if more:
        next((tmp_path / "pictures").iterdir()).unlink()  # a missing picture is drawn again
    monkeypatch.setattr(detect_command, "predict_groups", predicted := Mock(wraps=detect_command.predict_groups))
    command(*words, "--out boxes.json")
    number = done - bool(more)
    assert number == 0 or f"{number}/4  detected before" in capsys.readouterr().err
    assert len(predicted.call_args.kwargs["indices"]) == 4 - number
    assert (tmp_path / "boxes.json").read_bytes() == (tmp_path / "whole.json").read_bytes()
    assert not log.exists()
    if more:
        page = page_content(tmp_path / "page.html")
        assert [frame["name"] for frame in page["frames"]] == ["a.npy", "b.npy", "c.npy", "d.npy"]
        assert page["score"] == 0.3
        names = sorted(picture.name for picture in (tmp_path / "pictures").iterdir())
        assert names == [f"000{i}_{name}.npy.png" for i, name in enumerate("abcd", 1)]


@pytest.mark.slow
def test_pictures_of_files_with_one_name_follow_their_numbers(home, tmp_path, capsys, monkeypatch):
    """A resumed call has one more file before the others, so the second number is of another file."""
    monkeypatch.chdir(tmp_path)
    rng, clouds = np.random.default_rng(0), [Path(name) / "x.npy" for name in "abcd"]
    for number, cloud in enumerate(clouds, 1):
        cloud.parent.mkdir()
        np.save(cloud, np.load(home / "good.npy")[rng.permutation(100 * number)])
    how = "--pictures", "p", "--out", "x.json"
    assert_one_line_error(capsys, detect(home, *clouds[1:], "none.npy", *how), "none.npy: no such file")
    before = Path("p/0002_x.npy.png").read_bytes()
    command(*detect(home, *clouds, *how))
    assert Path("p/0002_x.npy.png").read_bytes() != before
    command(*detect(home, *clouds, "--pictures", "new", "--out", "y.json"))
    for picture in Path("new").iterdir():
        assert (Path("p") / picture.name).read_bytes() == picture.read_bytes()


def test_a_file_in_two_spellings_is_processed_once(home, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(home / "good.npy", "a.npy")
    shutil.copy(home / "good.npy", "b.npy")
    command(*detect(home, "./b.npy", "a.npy", tmp_path / "b.npy", "--out", "x.json"))
    assert [file["file"] for file in files_of(Path("x.json"))] == ["b.npy", "a.npy"]


def test_clouds_without_usable_points_have_no_boxes_and_are_counted(home, tmp_path, capsys):
    out, page = tmp_path / "boxes.json", tmp_path / "page.html"
    clouds = [home / f"{name}.npy" for name in ("no_rows", "good", "away")]
    command(*detect(home, *clouds, "--out", out, "--page", page, "--pictures", tmp_path))
    files = files_of(out)
    assert [file["file"] for file in files] == [*map(str, clouds)]
    assert [len(file["boxes"]) > 0 for file in files] == [False, True, False]
    assert [file["num_points"] > file["num_dropped"] for file in files] == [False, True, False]
    assert len(page_content(page)["frames"]) == len(list(tmp_path.glob("*.png"))) == 3
    note = "note: 2 of 3 clouds without usable points, and so without boxes: the first is "
    assert capsys.readouterr().err.count(f"{note}{clouds[0]}: no points in it") == 1
    for _ in range(2):  # also the second time, although the files are finished
        words = detect(home, clouds[0], clouds[2], "--out", tmp_path / "x.json")
        assert_one_line_error(capsys, words, "no_rows.npy: no points in it, expected at least one$")
        assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".html", ".png"}
        assert not (tmp_path / "x.json").exists()


def test_a_resumed_detect_repeats_clouds_with_another_calibration(home, tmp_path, capsys):
    root = make_kitti(tmp_path / "kitti", train=3, val=1, sensor=TINY)
    calibrations, folder, out = root / "training" / "calib", root / "training" / "velodyne", tmp_path / "x.json"
    calibrations.rename(tmp_path / "calib")
    missing = detect(home, *sorted(folder.iterdir()), folder / "none.bin", "--out", out)
    assert_one_line_error(capsys, missing, "none.bin: no such file")
    (tmp_path / "calib").rename(calibrations)
    command(*detect(home, folder, "--out", out))
    assert "detected before" not in capsys.readouterr().err
    assert_one_line_error(capsys, [*missing, "--full-turn"], "none.bin: no such file")
    shutil.rmtree(calibrations)
    command(*detect(home, folder, "--out", out), "--full-turn")
    assert "detected before" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["x.resume_log", "x", "x.json"])
def test_detect_accepts_any_name_for_its_output(home, tmp_path, name):
    command(*detect(home, home / "good.npy", "--out", tmp_path / name))
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert len(files_of(tmp_path / name)) == 1


@pytest.mark.parametrize(("option", "score"), [("", 0.3), ("--min-score 0.25", 0.25), ("--min-score 0", 0)])
def test_pages_and_pictures_show_boxes_from_one_score(home, tmp_path, monkeypatch, option, score):
    page = tmp_path / "page.html"
    monkeypatch.setattr(detect_command, "_draw", drawn := Mock())
    where = "--out", tmp_path / "x.json", "--pictures", tmp_path / "pictures"
    command(*detect(home, home / "good.npy", *where), option, "--page", page)
    assert page_content(page)["score"] == score
    assert drawn.call_args.args[-1] == score
    assert page_content(page)["frames"][0]["scores"] == [
        box["score"] for box in files_of(tmp_path / "x.json")[0]["boxes"]
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        *("--min-score 0.3", "--labels car", "--yaw-deg 90", "--remove-close none", "other clouds"),
        *("--intensity-scale 2", "--data-sensor kitti_hdl64e"),
    ],
)
def test_detect_does_not_resume_with_other_options_or_clouds(home, tmp_path, capsys, change):
    clouds = [shutil.copy(home / "good.npy", tmp_path / f"{name}.npy") for name in "abc"]
    out = "--out", tmp_path / "x.json"
    assert_one_line_error(capsys, detect(home, *clouds, tmp_path / "d.npy", *out), "d.npy: no such file")
    if change == "other clouds":
        for cloud in clouds:
            shutil.copy(home / "nan.npy", cloud)
    command(*detect(home, *clouds, *out), "" if change == "other clouds" else change)
    assert "detected before" not in capsys.readouterr().err
    assert len({file["num_dropped"] for file in files_of(tmp_path / "x.json")}) == 1


def test_two_detections_into_a_file_are_refused(home, tmp_path, capsys):
    with file_lock(tmp_path / ".x.json.resume_log"):
        words = detect(home, home / "good.npy", "--out", tmp_path / "x.json")
        assert_one_line_error(capsys, words, "x.json: in use: another process is detecting")


def test_file_names_may_hold_formulas_and_invalid_utf8(home, tmp_path):
    cloud = tmp_path / os.fsdecode(b"$\\frac{a$\xff.npy")
    shutil.copy(home / "good.npy", cloud)
    command(*detect(home, cloud, "--out", tmp_path / "a.json", "--pictures", tmp_path / "pictures"))
    assert files_of(tmp_path / "a.json")[0]["file"] == str(cloud)
    assert len(list((tmp_path / "pictures").iterdir())) == 1
    command("project", cloud, "--sensor tiny --out", tmp_path / "a.npz", "--png", tmp_path / "a.png")


def test_detect_fuses_sweeps(home, tmp_path, monkeypatch):
    sweep = {"file": str(home / "good.npy"), "sensor_to_world": np.eye(4).tolist()}
    out, sweeps = tmp_path / "boxes.json", tmp_path / "sweeps.json"
    sweeps.write_text(json.dumps([{**sweep, "timestamp_us": 10**6 - i} for i in range(3)]))
    several = dataclasses.replace(TINY_CONFIG, num_sweeps=2)
    save_checkpoint(tmp_path / "several", Checkpoint(several, TINY, untrained(several, TINY), 7))
    read = Mock(wraps=detect_command.read_list)
    monkeypatch.setattr(detect_command, "read_list", read)
    command("detect --sweeps", sweeps, "--checkpoint", tmp_path / "several", "--out", out)
    [result] = files_of(out)
    read.assert_called_once_with(sweeps)
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
    assert counts["num_close"] == 0  # as configurations read the current sweep
    assert png.stat().st_size > 10_000


# Each with "--checkpoint HOME/checkpoint" for detect and "--out OUT" unless it says otherwise.
BAD = mistakes(r"""
detect HOME/none.npy => none.npy: no such file
detect HOME/nothing => nothing: no point file in it, expected [^;]*$
detect HOME/empty.bin => empty.bin: empty file
detect HOME/cut.pcd.bin => cut.pcd.bin: .* not a multiple of 20
detect HOME/good.npy --yaw-deg nan => --yaw-deg: got nan, expected an angle in degrees
detect HOME/text.txt => unknown extension '.txt'
detect HOME/pickled.npy => pickled.npy: not a readable .npy
detect HOME/flat.npy => flat.npy: shape
detect HOME/future.npy => future.npy: time_lag
detect HOME/scaled_ring.npy => scaled_ring.npy: fifth column: got 16 different .* 1 \(num_sweeps\): .*--columns
project HOME/scaled_ring.npy => scaled_ring.npy: fifth column: got 16 different .* at most 10 \(num_sweeps\)
stream HOME/scaled_ring.npy --checkpoint HOME/checkpoint => scaled_ring.npy: fifth column: got 16 .* at most 1
benchmark HOME/scaled_ring.npy --checkpoint HOME/checkpoint => scaled_ring.npy: fifth column: got 16 .* at most 1
detect HOME/good.npy --viewpoint => good.npy: viewpoint: expected a .pcd file
project HOME/good.npy --viewpoint => good.npy: viewpoint: expected a .pcd file
stream HOME/good.npy --viewpoint --checkpoint HOME/checkpoint => good.npy: viewpoint: expected a .pcd file
detect HOME/broken.pcd => broken.pcd: not a readable .pcd file
detect HOME/away.npy => away.npy: none of its .* points is usable
detect HOME/no_rows.npy => no_rows.npy: no points in it, expected at least one
detect HOME/all_nan.npy => all_nan.npy: none .*\(5 not finite
detect HOME/good.npy HOME/none.npy => none.npy: no such file
detect => expected either point files or --sweeps
detect HOME/empty.bin --columns 9 => columns: got 9
detect HOME/good.npy --columns 5 => are for raw .bin files
detect HOME/s.json => s.json: expected a point file, or --sweeps before a list of sweeps
detect --sweeps HOME/s.json --full-turn => --full-turn: expected none with --sweeps
detect --sweeps HOME/good.npy => good.npy: expected a file that ends in .json
detect HOME/good.npy --out OUT --page OUT/../.out.resume_log => --page: .*the same file as
detect --sweeps HOME/s.json => s.json: no such file
detect HOME/good.npy --checkpoint HOME/none => none: found nothing, expected a check.*weights: hdl32e, quickstart$
detect HOME/good.npy --checkpoint HOME/good.npy => found a file, expected a checkpoint folder
detect HOME/good.npy --checkpoint HOME => no checkpoint.json in it, expected a .*, or the folder of a run
detect HOME/good.npy --checkpoint HOME/foreign => foreign: params/.*: got \(.*\), expected \(.*\): the arrays do
detect HOME/good.npy --checkpoint HOME/damaged => damaged.*: damaged
detect HOME/good.npy --checkpoint HOME/garbled => checkpoint.json: not JSON
detect HOME/good.npy --checkpoint HOME/old => format: got 0, expected 3
detect HOME/good.npy --checkpoint HOME/fields => fields/checkpoint.json: damaged
project HOME/none.bin => none.bin: no such file
project HOME/good.npy --sensor sonar => sonar: no such sensor
project HOME/good.npy --sensor HOME/sensor.json => sensor.json: inclinations_deg, inclinations_rad: missing
project HOME/good.npy --rounds 0 => --rounds: got 0
project HOME/away.npy => away.npy: none of its
project HOME/good.npy --sensor argoverse2 => good.npy: no laser number
project HOME/good.npy --out HOME => found a folder
detect HOME/good.npy --out HOME/good.npy => --out: .*the same file as .*good.npy
detect HOME/good.npy --out HOME/link.json => --out: .*the same file as
detect HOME/none.npy --out HOME/link.json => link.json: found a link to .*good
detect HOME/none.npy --out . => error: .: found a folder, expected a file to write
detect HOME/none.npy --out /dev/null => /dev/null: found a device or a pipe
detect HOME/none.npy --out HOME/checkpoint/boxes.json => --out: .*inside of the checkpoint
detect HOME/none.npy --pictures HOME/checkpoint/pictures => --pictures: .*inside of the checkpoint
synthesize --scenes 1 --sensor argoverse2 => --sensor: got argoverse2, whose rows come from laser numbers
detect HOME/none.npy --out HOME/good.npy/x => good.npy: found a file, expected a fol
detect HOME/none.npy --pictures HOME/good.npy => --pictures: .*: found a file, expect
detect HOME/good.npy --min-score 50 => --min-score: got 50, expected a score of 0 to 1
detect HOME/good.npy --min-score nan => --min-score: got nan, expected a score
detect HOME/good.npy --max-file-points 10 => good.npy: .*points, expected at most 10$
project HOME/good.npy --out OUT --png OUT => --png: .*out: the same file as .*out
project HOME/good.npy --png HOME/good.npy => --png: .*the same file as
project HOME/good.npy --max-file-points 10 => points, expected at most 10$
demo --out HOME/good.npy => --out: .*: found a file
demo --keyframes 0 => --keyframes: got 0
""")


@pytest.mark.parametrize(("line", "message"), BAD)
def test_mistakes_get_one_line_and_leave_nothing(home, tmp_path, capsys, line, message):
    line += "" if "--out" in line else " --out OUT"
    line += " --checkpoint HOME/checkpoint" if line.startswith("detect") and "--checkpoint" not in line else ""
    args = line.replace("HOME", str(home)).replace("OUT", str(tmp_path / "out")).split()
    assert_one_line_error(capsys, args, message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("line", ["detct", "detect --checkpiont x", "project", "demo --drive many"])
def test_usage_errors_exit_with_2(line):
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    assert stopped.value.code == 2


def test_usage_error_names_the_nearest_option(capsys):
    with pytest.raises(SystemExit):
        main(["detect", "x.npy", "--out", "a", "--chekpoint", "b"])
    printed = capsys.readouterr()
    assert "--checkpoint" in printed.err + printed.out


def test_help_has_one_line_per_command(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    listed = capsys.readouterr().out.partition("(required)")[2].splitlines()
    lines = [line.strip("│╰╯─ ") for line in listed]
    assert [line.split()[:2] for line in filter(None, lines)] == [["•", name] for name in _COMMANDS]


def test_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"fcos-lidar {__version__}\n"


@pytest.mark.parametrize("name", _COMMANDS)
def test_help_describes_every_option(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert stopped.value.code == 0
    text = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
    assert "--data-root" in text if name == "prepare" else "--out" in text
    # An option without a text would be followed at once by its default; None is not a helpful default.
    assert re.findall(r"--[\w-]+(?: [^ a-z]\S*)? \((?:default|optional|required)", text) == []
    assert "default: None" not in text


@pytest.fixture(scope="module")
def drive(home):
    """The results of a demo of three keyframes, with a network that compiles in seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "shipped_checkpoints", lambda: {demo.WEIGHTS: home / "checkpoint"})
        patch.chdir(home)
        (home / demo.WEIGHTS).mkdir()  # a folder of this name does not matter
        command("demo --keyframes 3 --out", home / "demo")
    return home / "demo"


@pytest.mark.slow
def test_demo_writes_the_metrics_of_evaluate_on_its_drive(drive, home, tmp_path):
    place = ["--data-root", drive / "drive", "--split", "train", "--checkpoint", home / "checkpoint"]
    command("evaluate --no-report --out", tmp_path / "evaluation", *place)
    demo_metrics, metrics = (
        json.loads((folder / "metrics_summary.json").read_text()) for folder in (drive, tmp_path / "evaluation")
    )
    assert demo_metrics.pop("eval_time") > 0 < metrics.pop("eval_time")
    assert demo_metrics["cfg"]["max_boxes_per_sample"] == 500
    assert json.dumps(demo_metrics) == json.dumps(metrics)
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


def test_a_checkpoint_replaces_another_completely(home, tmp_path):
    checkpoint = load_checkpoint(home / "checkpoint")
    save_checkpoint(tmp_path / "c", checkpoint)
    doubled = jax.tree.map(lambda leaf: leaf * 2, checkpoint.variables)
    save_checkpoint(tmp_path / "c", dataclasses.replace(checkpoint, variables=doubled, step=8))
    again = load_checkpoint(tmp_path / "c")
    assert (again.step, bits(again.variables)) == (8, bits(doubled))
    assert [path.name for path in tmp_path.iterdir()] == ["c"]
