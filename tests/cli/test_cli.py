"""The command line as a user meets it: good runs, and one line for every mistake."""

import dataclasses
import json
import re
import shutil

import jax
import numpy as np
import pytest

from fcos_lidar_jax.cli import main
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import Checkpoint, CheckpointError, load_checkpoint, save_checkpoint
from fcos_lidar_jax.types import CLASSES


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with an untrained checkpoint, a damaged and a foreign one, and clouds good and bad."""
    folder = tmp_path_factory.mktemp("home")
    variables = build_detector(QUICKSTART, TINY).init(jax.random.key(0))
    # Less background, so that even untrained there are boxes to write.
    for level in range(2, 8):
        bias = variables["params"]["heads"][f"level{level}"]["classification"]["logits_bias"]
        variables["params"]["heads"][f"level{level}"]["classification"]["logits_bias"] = bias.at[-1].set(0.0)
    checkpoint = Checkpoint(QUICKSTART, TINY, variables, 7)
    save_checkpoint(folder / "checkpoint", checkpoint)
    wide = dataclasses.replace(QUICKSTART, model=dataclasses.replace(QUICKSTART.model, fpn_channels=48))
    save_checkpoint(folder / "foreign", dataclasses.replace(checkpoint, config=wide))
    shutil.copytree(folder / "checkpoint", folder / "damaged")
    for file in (folder / "damaged" / "variables").rglob("*"):
        if file.is_file() and file.stat().st_size > 1000:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for name, text in (("garbled", "{"), ("old", '{"format": 0}'), ("fields", None)):
        shutil.copytree(folder / "checkpoint", folder / name)
        if text is None:
            record = json.loads((folder / name / "checkpoint.json").read_text())
            record["config"]["model"]["fpn_channels"] = "wide"
            text = json.dumps(record)
        (folder / name / "checkpoint.json").write_text(text)
    points = make_frame(0, TINY).points
    np.save(folder / "good.npy", points)
    points[11, 1] = np.nan
    np.save(folder / "nan.npy", points)
    rows = points.copy()
    rows[:, :2] += 500
    np.save(folder / "away.npy", rows)
    np.save(folder / "all_nan.npy", np.full((5, 5), np.nan, np.float32))
    np.save(folder / "pickled.npy", np.array([{"a": 1}], object), allow_pickle=True)
    np.save(folder / "flat.npy", np.zeros(4, np.float32))
    np.save(folder / "future.npy", np.full((4, 5), -1.0, np.float32))
    (folder / "nothing").mkdir()
    (folder / "empty.bin").write_bytes(b"")
    (folder / "cut.pcd.bin").write_bytes(points.tobytes()[:-3])
    (folder / "text.txt").write_text("1 2 3")
    (folder / "broken.pcd").write_text("no header")
    (folder / "sensor.json").write_text('{"name": "x", "num_columns": "many"}')
    return folder


def test_detect_writes_the_contract(home, tmp_path, capsys):
    out = tmp_path / "boxes.json"
    files = [str(home / "good.npy"), str(home / "nan.npy")]
    code = main(
        [
            "detect",
            *files,
            "--checkpoint",
            str(home / "checkpoint"),
            "--out",
            str(out),
            "--pictures",
            str(tmp_path),
        ]
    )
    assert code == 0
    progress = capsys.readouterr().err.strip().splitlines()
    assert len(progress) == 2
    assert "2/2" in progress[1]
    good, bad = json.loads(out.read_text())["files"]
    assert good["file"] == files[0]
    assert good["num_points"] == len(np.load(files[0])) == bad["num_points"]
    assert bad["num_dropped"] == good["num_dropped"] + 1
    for box in good["boxes"]:
        assert set(box) == {"label", "score", "box"}
        assert box["label"] in CLASSES
        assert 0 < box["score"] <= 1
        assert len(box["box"]) == 9
        assert -np.pi <= box["box"][6] < np.pi
    scores = [box["score"] for box in good["boxes"]]
    assert len(scores) > 0
    assert scores == sorted(scores, reverse=True)
    assert len(list(tmp_path.glob("*.png"))) == 2


def test_detect_fuses_sweeps(home, tmp_path):
    eye = np.eye(4).tolist()
    entries = [
        {"file": str(home / "good.npy"), "timestamp_us": 10**6 - i, "sensor_to_world": eye} for i in range(2)
    ]
    (tmp_path / "s.json").write_text(json.dumps(entries))
    out = tmp_path / "boxes.json"
    args = ["detect", "--sweeps", str(tmp_path / "s.json"), "--checkpoint", str(home / "checkpoint")]
    assert main([*args, "--out", str(out)]) == 0
    (result,) = json.loads(out.read_text())["files"]
    points = np.load(home / "good.npy")
    close = (np.abs(points[:, :2]) < 1).all(axis=1).sum()
    assert result["num_points"] == 2 * len(points)
    assert result["num_close"] == 2 * close > 0


def test_project_writes_index_features_counts_and_picture(home, tmp_path, capsys):
    out, png = tmp_path / "image.npz", tmp_path / "image.png"
    code = main(["project", str(home / "nan.npy"), "--out", str(out), "--png", str(png), "--sensor", "tiny"])
    assert code == 0
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


CHECKPOINT = ["--checkpoint", "{home}/checkpoint", "--out", "{out}"]
BAD = {
    "missing file": (["detect", "{home}/none.npy", *CHECKPOINT], "none.npy: no such file"),
    "folder without clouds": (["detect", "{home}/nothing", *CHECKPOINT], "nothing: no point file in it"),
    "empty file": (["detect", "{home}/empty.bin", *CHECKPOINT], "empty.bin: empty file"),
    "truncated file": (["detect", "{home}/cut.pcd.bin", *CHECKPOINT], "cut.pcd.bin: .* not a multiple of 20"),
    "unknown extension": (["detect", "{home}/text.txt", *CHECKPOINT], "unknown extension '.txt'"),
    "pickled array": (["detect", "{home}/pickled.npy", *CHECKPOINT], "pickled.npy: not a readable .npy"),
    "one axis": (["detect", "{home}/flat.npy", *CHECKPOINT], "flat.npy: shape"),
    "negative lag": (["detect", "{home}/future.npy", *CHECKPOINT], "future.npy: time_lag"),
    "broken pcd": (["detect", "{home}/broken.pcd", *CHECKPOINT], "broken.pcd: not a PCD file"),
    "out of range": (["detect", "{home}/away.npy", *CHECKPOINT], "away.npy: none of its .* points is usable"),
    "nothing finite": (["detect", "{home}/all_nan.npy", *CHECKPOINT], r"all_nan.npy: none .*\(5 not finite"),
    "good then bad": (["detect", "{home}/good.npy", "{home}/none.npy", *CHECKPOINT], "none.npy: no such file"),
    "no input": (["detect", *CHECKPOINT], "expected point files or --sweeps"),
    "bad columns": (["detect", "{home}/empty.bin", "--columns", "9", *CHECKPOINT], "columns: got 9"),
    "columns of npy": (["detect", "{home}/good.npy", "--columns", "5", *CHECKPOINT], "are for raw .bin files"),
    "missing sweeps": (["detect", "--sweeps", "{home}/s.json", *CHECKPOINT], "s.json: no such file"),
    "no checkpoint": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/none", "--out", "{out}"],
        "none: found nothing, expected a checkpoint folder",
    ),
    "file for a checkpoint": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/good.npy", "--out", "{out}"],
        "found a file, expected a checkpoint folder",
    ),
    "folder without checkpoint": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}", "--out", "{out}"],
        "no checkpoint.json in it",
    ),
    "checkpoint of another preset": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/foreign", "--out", "{out}"],
        r"foreign: params/.*: got \(.*\), expected \(.*\): the arrays are not",
    ),
    "damaged checkpoint": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/damaged", "--out", "{out}"],
        "damaged.*: damaged",
    ),
    "garbled description": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/garbled", "--out", "{out}"],
        "checkpoint.json: not JSON",
    ),
    "old format": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/old", "--out", "{out}"],
        "format: got 0, expected 3",
    ),
    "bad field": (
        ["detect", "{home}/good.npy", "--checkpoint", "{home}/fields", "--out", "{out}"],
        "fields/checkpoint.json: not as it was written",
    ),
    "project missing": (["project", "{home}/none.bin", "--out", "{out}"], "none.bin: no such file"),
    "project sensor": (
        ["project", "{home}/good.npy", "--out", "{out}", "--sensor", "sonar"],
        "sonar: no such sensor",
    ),
    "project sensor file": (
        ["project", "{home}/good.npy", "--out", "{out}", "--sensor", "{home}/sensor.json"],
        "sensor.json: .*: ",
    ),
    "project rounds": (["project", "{home}/good.npy", "--out", "{out}", "--rounds", "0"], "--rounds: got 0"),
    "project away": (["project", "{home}/away.npy", "--out", "{out}"], "away.npy: none of its"),
    "project laser": (
        ["project", "{home}/good.npy", "--out", "{out}", "--sensor", "argoverse2"],
        "good.npy: no laser number",
    ),
    "project into a folder": (["project", "{home}/good.npy", "--out", "{home}"], "found a folder"),
    "demo into a file": (["demo", "--out", "{home}/good.npy"], "--out: .*: found a file"),
    "demo with fewer than no steps": (["demo", "--out", "{out}", "--steps", "-1"], "--steps: got -1"),
}


@pytest.mark.parametrize("name", BAD)
def test_mistakes_get_one_line_and_leave_nothing(home, tmp_path, capsys, name):
    args, message = BAD[name]
    out = tmp_path / "out"
    code = main([a.format(home=home, out=out) for a in args])
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("fcos-lidar: error: ")]
    assert code == 1
    assert len(errors) == 1
    assert re.search(message, errors[0]), errors[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "args", [["detct"], ["detect", "--checkpiont", "x"], ["project"], ["demo", "--steps", "many"]]
)
def test_usage_errors_exit_with_2(args, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(args)
    assert stopped.value.code == 2


def test_usage_error_names_the_nearest_option(capsys):
    with pytest.raises(SystemExit):
        main(["detect", "x.npy", "--out", "a", "--chekpoint", "b"])
    shown = capsys.readouterr()
    assert "--checkpoint" in shown.err + shown.out


@pytest.mark.parametrize("command", ["demo", "synthesize", "train", "evaluate", "detect", "project"])
def test_help_explains(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    assert "--out" in capsys.readouterr().out


@pytest.mark.slow
def test_demo_from_nothing_to_report(tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out), "--steps", "2", "--test-frames", "3"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["training"]["steps"] == 2
    for model in ("shipped", "before", "after"):
        assert {*metrics[model]["label_aps"], *metrics[model]["absent_classes"]} == set(QUICKSTART.classes)
    report = (out / "report.html").read_text()
    assert report.count("data:image/png;base64,") == 9
    assert "http" not in report
    unseen = np.load(out / "unseen" / "frame_000.npy")
    boxes = tmp_path / "boxes.json"
    args = ["detect", str(out / "unseen" / "frame_000.npy"), "--checkpoint", str(out / "run")]
    assert main([*args, "--out", str(boxes)]) == 0
    assert json.loads(boxes.read_text())["files"][0]["num_points"] == len(unseen)


def test_checkpoints_round_trip_and_replace_each_other_whole(home, tmp_path):
    first = load_checkpoint(home / "checkpoint")
    assert (first.config, first.sensor, first.step) == (QUICKSTART, TINY, 7)
    save_checkpoint(tmp_path / "c", first)
    doubled = jax.tree.map(lambda leaf: leaf * 2, first.variables)
    save_checkpoint(tmp_path / "c", dataclasses.replace(first, variables=doubled, step=8))
    again = load_checkpoint(tmp_path / "c")
    assert again.step == 8
    for a, b in zip(jax.tree.leaves(doubled), jax.tree.leaves(again.variables), strict=True):
        np.testing.assert_array_equal(a, b)
    assert [p.name for p in tmp_path.iterdir()] == ["c"]
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path)
