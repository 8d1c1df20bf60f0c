"""The commands ``detect``, ``project`` and ``demo``: their results, and one line per mistake in any command."""

import json
import os
import re
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from commands import assert_one_line_error, command, page_content
from PIL import Image
from tiny_run import save_untrained

from fcos_lidar_jax import __version__
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import demo, main
from fcos_lidar_jax.cli.commands import _COMMANDS
from fcos_lidar_jax.files import file_lock
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with clouds and an untrained detector."""
    folder = tmp_path_factory.mktemp("home")
    save_untrained(folder / "checkpoint")
    points = make_frame(0, TINY).points
    np.save(folder / "good.npy", points)
    points[11, 1] = np.nan
    np.save(folder / "nan.npy", points)
    np.save(folder / "away.npy", points + np.array([500, 500, 0, 0, 0], np.float32))
    np.save(folder / "no_rows.npy", points[:0])
    return folder


def detect(home, *words):
    """The arguments of ``detect`` with the detector of ``home``."""
    return ["detect", *map(str, words), "--checkpoint", str(home / "checkpoint")]


def files_of(out):
    return json.loads(out.read_text())["files"]


def test_detect_writes_boxes_pictures_and_a_page(home, tmp_path, capsys):
    out, clouds, page = tmp_path / "boxes.json", [home / "good.npy", home / "nan.npy"], tmp_path / "page.html"
    command(*detect(home, *clouds, "--out", out, "--pictures", tmp_path, "--page", page))
    told = capsys.readouterr().err
    assert told.count("compiling the detector: up to a minute on a CPU") == 1
    progress = [line for line in told.splitlines() if line.startswith("files ")]
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


@pytest.mark.slow
def test_an_interrupted_detect_resumes(home, tmp_path, capsys, monkeypatch):
    """A call that a missing file ends goes on with it, and detects again in clouds that have changed."""
    monkeypatch.chdir(tmp_path)
    clouds = [shutil.copy(home / "good.npy", tmp_path / f"{name}.npy") for name in "abcd"]
    words = detect(home, *clouds, "--page", "page.html", "--pictures", "pictures")
    command(*words, "--out whole.json")
    shutil.rmtree("pictures")
    shutil.move(clouds[3], tmp_path / "away.npy")
    log = tmp_path / ".boxes.json.resume_log"
    assert_one_line_error(capsys, [*words, "--out", "boxes.json"], "d.npy: no such file")
    assert not (tmp_path / "boxes.json").exists()
    done = len(log.read_text().splitlines()) - 1
    assert 1 <= done <= 3
    with file_lock(log):
        assert_one_line_error(capsys, [*words, "--out", "boxes.json"], "in use: another process is detecting")
    shutil.move(tmp_path / "away.npy", clouds[3])
    os.utime(clouds[0], (1, 1))  # as if it was written again
    command(*words, "--out boxes.json")
    told = capsys.readouterr().err
    assert done == 1 or f"files {done - 1}/4  detected before" in told
    assert (tmp_path / "boxes.json").read_bytes() == (tmp_path / "whole.json").read_bytes()
    assert not log.exists()
    page = page_content(tmp_path / "page.html")
    assert [frame["name"] for frame in page["frames"]] == ["a.npy", "b.npy", "c.npy", "d.npy"]
    assert page["score"] == 0.3
    names = sorted(picture.name for picture in (tmp_path / "pictures").iterdir())
    assert names == [f"000{i}_{name}.npy.png" for i, name in enumerate("abcd", 1)]


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


@pytest.mark.parametrize(("option", "score"), [("", 0.3), ("--min-score 0.25", 0.25)])
def test_pages_and_pictures_show_boxes_from_one_score(home, tmp_path, monkeypatch, option, score):
    page = tmp_path / "page.html"
    monkeypatch.setattr("fcos_lidar_jax.visualization.bev.draw_bev", drawn := Mock())
    where = "--out", tmp_path / "x.json", "--pictures", tmp_path / "pictures"
    command(*detect(home, home / "good.npy", *where), option, "--page", page)
    assert page_content(page)["score"] == score
    assert drawn.call_args.kwargs["detections"][2].min() >= score
    assert f"score {score:g} and more" in drawn.call_args.kwargs["title"]
    assert page_content(page)["frames"][0]["scores"] == [
        box["score"] for box in files_of(tmp_path / "x.json")[0]["boxes"]
    ]


def test_file_names_may_hold_formulas_and_invalid_utf8(home, tmp_path):
    cloud = tmp_path / os.fsdecode(b"$\\frac{a$\xff.npy")
    shutil.copy(home / "good.npy", cloud)
    command(*detect(home, cloud, "--out", tmp_path / "a.json", "--pictures", tmp_path / "pictures"))
    assert files_of(tmp_path / "a.json")[0]["file"] == str(cloud)
    assert len(list((tmp_path / "pictures").iterdir())) == 1
    command("project", cloud, "--sensor tiny --out", tmp_path / "a.npz", "--png", tmp_path / "a.png")


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
    command("project", home / "nan.npy", "--out", out, "--sensor nuscenes_hdl32e")
    assert "warning: " in (told := capsys.readouterr().err)
    assert "points do not fit sensor 'nuscenes_hdl32e'" in told


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("detct", "detect"),
        ("detect --chekpoint x", "--checkpoint"),
        ("demo --drive many", "--drive"),
        ("detect --checkpoint x --out x", "error: INPUT: got none, expected one, or --sweeps\n"),
        ("stream --checkpoint x --out x", "error: SOURCE: got none, expected one, or --data-root\n"),
        ("evaluate --out x", "error: --checkpoint: got none, expected one, or --results\n"),
        ("train quickstart --out x", "error: --data-root: got none, expected one\n"),
        ("prepare --format kitti", "error: --data-root: got none, expected one\n"),
        ("evaluate --results x --out x", "error: --data-root: got none, expected one, or --ground-truth\n"),
    ],
)
def test_usage_errors_exit_with_2_and_name_the_nearest_option(line, named, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    assert stopped.value.code == 2
    printed = capsys.readouterr()
    assert named in printed.err + printed.out


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
