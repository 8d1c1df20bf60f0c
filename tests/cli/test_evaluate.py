"""``fcos-lidar evaluate``: from files and from a checkpoint, resumed, reported; one line per mistake."""

import dataclasses
import json
import os
import re
import shutil

import jax
import numpy as np
import pytest
from commands import page_content
from made_evaluation import SPLIT, VERSION, make_task, truth_of, write_task
from metrics_oracle import leaves
from tiny_run import save_untrained

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.evaluate import Evaluate, run
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation import evaluate_detections
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.inference.prediction_log import _fingerprint
from fcos_lidar_jax.sensors import TINY, sensor_to_json
from fcos_lidar_jax.simulation.frames import make_frame

FILES = {"metrics_summary.json", "curves.json", "results_nusc.json", ".lock"}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A data root with simulated sweeps, its truth as a file, and an untrained checkpoint."""
    folder = tmp_path_factory.mktemp("home")
    tables, results = make_task(0, samples=3, noise=0.4)
    write_task(folder, tables, results)
    for i, row in enumerate(tables["sample_data"]):
        file = folder / row["filename"]
        file.parent.mkdir(parents=True, exist_ok=True)
        make_frame(i, TINY).points.tofile(file)
    (folder / "truth.json").write_text(json.dumps(truth_of(tables)))
    save_untrained(folder / "checkpoint")
    return folder


def place(home):
    return {"data": DataOptions(data_root=home, version=VERSION), "split": SPLIT}


def read(file):
    return json.loads(file.read_text())


def by_files(folder, results, truth, **options):
    """Evaluate results against truth, both given as content of files, into the folder ``out``."""
    for name, content in (("r.json", results), ("t.json", truth)):
        (folder / name).write_text(json.dumps(content))
    files = {"results": folder / "r.json", "ground_truth": folder / "t.json"}
    run(Evaluate(DataOptions(), folder / "out", **files, **options))


@pytest.fixture(scope="module")
def by_tables(home, tmp_path_factory):
    """The results file evaluated against the tables, with intervals and a report: the output folder.

    The given sensor has another heading than the clouds."""
    out, sensor = tmp_path_factory.mktemp("by_tables"), home / "x_ahead.json"
    sensor.write_text(json.dumps({**sensor_to_json(TINY), "forward_rad": 0.0}))
    run(Evaluate(out=out, results=home / "results.json", **place(home), bootstrap=20, sensor=str(sensor)))
    return out


@pytest.mark.slow
def test_results_against_a_file_of_truth_and_against_the_tables(home, by_tables, tmp_path, capsys):
    results, truth = home / "results.json", home / "truth.json"
    run(Evaluate(DataOptions(), tmp_path, results=results, ground_truth=truth, report=False))
    printed = capsys.readouterr()
    summaries = [read(folder / "metrics_summary.json") for folder in (tmp_path, by_tables)]
    expected = evaluate_detections(read(results), read(truth))
    assert list(summaries[0]) == list(expected)
    for summary in (*summaries, expected):
        assert summary.pop("eval_time") > 0
    assert json.dumps(summaries[0]) == json.dumps(summaries[1]) == json.dumps(expected)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    assert read(tmp_path / "results_nusc.json") == read(results)
    assert f"NDS {expected['nd_score']:.4f}  mAP {expected['mean_ap']:.4f}  on 6 samples" in printed.out
    assert re.search(r"warning: .*rotation: normalised", printed.err)


def test_a_page_shows_the_worst_and_the_best_frames(by_tables):
    page, summary = page_content(by_tables / "frames.html"), read(by_tables / "metrics_summary.json")
    assert page["classes"] == list(summary["label_aps"])
    assert page["forward_rad"] == np.pi / 2
    assert page["frames"][0]["name"].startswith("worst 1: ")
    assert {frame["name"].split()[0] for frame in page["frames"]} == {"worst", "best"}
    for frame in page["frames"]:
        assert frame["num_points"] > 100
        assert len(frame["truth"]) == len(frame["truth_labels"]) > 0
    assert 'href="frames.html"' in (by_tables / "report.html").read_text()


def test_the_report_shows_the_metrics_of_the_summary(by_tables):
    page = (by_tables / "report.html").read_text()
    summary, drawn = read(by_tables / "metrics_summary.json"), read(by_tables / "bootstrap.json")
    text = re.sub(r'src="data:[^"]*"', "", page)
    assert "http" not in text
    # 10 precision and 10 error curves; three samples from above and as range images.
    assert page.count("data:image/png;base64,") == 26
    cells = re.findall(r"<td>([^<]*)</td>", text[text.index("<body>") :])
    numbers = {cell for cell in cells if re.fullmatch(r"\d+\.\d{3}", cell)}
    assert numbers <= {f"{value:.3f}" for value in leaves(summary).values() if isinstance(value, float)}
    for value in (summary["nd_score"], summary["mean_ap"], *summary["tp_errors"].values()):
        assert f"{value:.3f}" in numbers
    spans = {f"{drawn[key]['low']:.3f} to {drawn[key]['high']:.3f}" for key in ("nd_score", "mean_ap")}
    assert spans == {cell for cell in cells if " to " in cell}
    assert drawn["mean_ap"]["low"] <= summary["mean_ap"] <= drawn["mean_ap"]["high"]


@pytest.mark.slow
def test_a_checkpoint_is_evaluated_and_larger_batches_change_boxes_only_by_rounding(home, tmp_path, capsys):
    """tests/cli/test_processes.py resumes an evaluation."""
    options = {"checkpoint": home / "checkpoint", **place(home), "report": False}
    run(Evaluate(out=tmp_path / "single", **options))
    assert "frames 6/6" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "single").iterdir()} == FILES
    run(Evaluate(out=tmp_path / "pairs", batch_size=2, **options))
    single, pairs = (read(tmp_path / name / "results_nusc.json") for name in ("single", "pairs"))
    assert single["meta"]["use_lidar"]
    assert set(single["results"]) == {f"s{s}k{k}" for s in range(2) for k in range(3)}
    for token, boxes in single["results"].items():
        assert 0 < len(boxes) <= 30
        assert [b["detection_name"] for b in boxes] == [b["detection_name"] for b in pairs["results"][token]]
        for field in ("translation", "size", "detection_score"):
            expected, values = ([box[field] for box in part] for part in (boxes, pairs["results"][token]))
            np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-4)


def test_a_resume_log_of_another_detector_is_not_used(home):
    detector, data = load_detector(home / "checkpoint"), NuScenes(home, VERSION)
    tokens = tuple(data.split(SPLIT))
    frames, fewer = (NuScenesFrames(data, part, sensor=TINY) for part in (tokens, tokens[1:]))
    other = dataclasses.replace(detector, variables=jax.tree.map(lambda leaf: leaf + 1, detector.variables))
    ahead = dataclasses.replace(frames, sensor=dataclasses.replace(TINY, forward_rad=0.0))
    runs = (
        *((detector, frames, 1, None), (other, frames, 1, None), (detector, fewer, 1, None)),
        *((detector, frames, 2, None), (detector, frames, 1, 0.1), (detector, ahead, 1, None)),
    )
    fingerprints = {_fingerprint(*run) for run in runs}
    assert len(fingerprints) == len(runs)
    states = [frames.clouds_fingerprint([index]) for index in range(len(tokens))]
    os.utime(home / next(iter(data.sweep_files(tokens[0], 1))))  # as if the cloud was written again
    changed = [frames.clouds_fingerprint([index]) for index in range(len(tokens))]
    assert [now in states for now in changed] == [False, *[True] * (len(tokens) - 1)]


@pytest.mark.slow
def test_an_earlier_report_is_removed(home, by_tables, tmp_path):
    shutil.copytree(by_tables, tmp_path / "out")
    mine = tmp_path / "out" / "pictures" / "mine.png"
    mine.write_bytes(b"")
    by_files(tmp_path, read(home / "results.json"), read(home / "truth.json"), report=False)
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"pictures"}
    assert list(mine.parent.iterdir()) == [mine]


def test_with_a_class_map_the_metric_is_not_the_official_one(home, tmp_path):
    (tmp_path / "map.json").write_text(json.dumps(dict.fromkeys(NUSCENES_CLASSES[1:], None)))
    data = dataclasses.replace(place(home)["data"], class_map=str(tmp_path / "map.json"))
    run(Evaluate(data, tmp_path / "out", split=SPLIT, checkpoint=home / "checkpoint", report=False))
    summary = read(tmp_path / "out" / "metrics_summary.json")
    assert "nd_score" not in summary
    assert list(summary["mean_dist_aps"]) == ["car"]
    assert (tmp_path / "out" / "detections.json").exists()


@pytest.mark.slow
def test_results_need_only_the_tables(home, by_tables, tmp_path, capsys):
    """Without point files the report shows only boxes. The folder's name is not valid UTF-8."""
    root = tmp_path / os.fsdecode(b"M\xfcnchen")
    shutil.copytree(home / VERSION, root / VERSION)
    options = {**place(home), "data": DataOptions(data_root=root, version=VERSION)}
    run(Evaluate(out=tmp_path / "out", results=home / "results.json", **options))
    printed = capsys.readouterr()
    assert "6 files of keyframes are missing: the report shows boxes without points" in printed.err
    assert "mAP" in printed.out
    summary, expected = (read(folder / "metrics_summary.json") for folder in (tmp_path / "out", by_tables))
    assert summary["mean_ap"] == expected["mean_ap"] > 0
    assert "M?nchen" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
