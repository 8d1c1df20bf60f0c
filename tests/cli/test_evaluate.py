"""The command `evaluate`: from files, from a checkpoint, restarted, reported; one line for every mistake."""

import dataclasses
import json
import re

import jax
import numpy as np
import pytest
from made_evaluation import SPLIT, VERSION, make_task, truth_of, write_task

from fcos_lidar_jax.cli import evaluate
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.evaluate import Evaluate, run
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation import evaluate_detections
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.trainer.results import _fingerprint
from fcos_lidar_jax.training import Checkpoint, save_checkpoint

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
    config = dataclasses.replace(
        QUICKSTART, inference=dataclasses.replace(QUICKSTART.inference, candidates_per_level=20, max_detections=30)
    )
    shapes = jax.eval_shape(build_detector(config, TINY).init, jax.random.key(0))
    variables = jax.tree_util.tree_map_with_path(fill, shapes)
    save_checkpoint(folder / "checkpoint", Checkpoint(config, TINY, variables, 0))
    return folder


def fill(path, leaf):
    """Random weights without the compilation of their initialiser, and no bias towards the background."""
    name = path[-1].key
    if name == "kernel":
        return np.random.default_rng(leaf.size).normal(0, 0.05, leaf.shape).astype(leaf.dtype)
    return np.full(leaf.shape, float(name in ("scale", "var")), leaf.dtype)


def place(home):
    return {"data": DataOptions(data_root=home, version=VERSION), "split": SPLIT}


def read(file):
    return json.loads(file.read_text())


def test_results_against_a_file_of_truth_and_against_the_tables(home, tmp_path, capsys):
    results = home / "results.json"
    run(Evaluate(DataOptions(), tmp_path / "a", results=results, ground_truth=home / "truth.json", report=False))
    shown = capsys.readouterr()
    run(Evaluate(out=tmp_path / "b", results=results, **place(home), report=False))
    by_file, by_tables = (read(tmp_path / name / "metrics_summary.json") for name in "ab")
    expected = evaluate_detections(read(results), read(home / "truth.json"))
    assert list(by_file) == list(expected)
    for summary in (by_file, by_tables, expected):
        assert summary.pop("eval_time") > 0
    assert json.dumps(by_file) == json.dumps(by_tables) == json.dumps(expected)
    assert {path.name for path in (tmp_path / "a").iterdir()} == FILES
    assert read(tmp_path / "a" / "results_nusc.json") == read(results) or "NaN" in results.read_text()
    assert f"NDS {by_file['nd_score']:.4f}  mAP {by_file['mean_ap']:.4f}  on 6 samples" in shown.out
    assert re.search(r"warning: .*rotation: normalised", shown.err)


def test_the_official_keys_in_the_official_order(home, tmp_path):
    run(Evaluate(out=tmp_path, results=home / "results.json", **place(home), report=False))
    summary = read(tmp_path / "metrics_summary.json")
    assert list(summary) == [
        "label_aps",
        "mean_dist_aps",
        "mean_ap",
        "label_tp_errors",
        "tp_errors",
        "tp_scores",
        "nd_score",
        "eval_time",
        "cfg",
        "meta",
    ]
    assert list(summary["label_aps"]["car"]) == ["0.5", "1.0", "2.0", "4.0"]
    curves = read(tmp_path / "curves.json")
    precision = np.array(curves["classes"]["car"]["precision"]["2.0"])
    ap = np.maximum(precision[11:] - 0.1, 0).mean() / 0.9
    assert summary["label_aps"]["car"]["2.0"] == pytest.approx(ap)


def test_the_report_shows_the_numbers_of_the_summary(home, tmp_path):
    run(Evaluate(out=tmp_path, results=home / "results.json", **place(home), bootstrap=20, sensor="tiny"))
    page = (tmp_path / "report.html").read_text()
    summary, drawn = read(tmp_path / "metrics_summary.json"), read(tmp_path / "bootstrap.json")
    text = re.sub(r'src="data:[^"]*"', "", page)
    assert "http" not in text
    # 10 precision and 10 error curves; the three samples from above and as range images.
    assert page.count("data:image/png;base64,") == 26
    body = text[text.index("<body>") :]
    cells = re.findall(r"<td>([^<]*)</td>", body)
    shown = {cell for cell in cells if re.fullmatch(r"\d+\.\d{3}", cell)}
    numbers = {f"{value:.3f}" for value in leaves(summary) if isinstance(value, float)}
    assert shown <= numbers
    for value in (summary["nd_score"], summary["mean_ap"], *summary["tp_errors"].values()):
        assert f"{value:.3f}" in shown
    spans = {f"{drawn[key]['low']:.3f} to {drawn[key]['high']:.3f}" for key in ("nd_score", "mean_ap")}
    assert spans == {cell for cell in cells if " to " in cell}
    assert drawn["mean_ap"]["low"] <= summary["mean_ap"] <= drawn["mean_ap"]["high"]


def leaves(value):
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in leaves(part)]
    return [value]


def test_a_checkpoint_is_run_restarted_and_evaluated(home, tmp_path, monkeypatch, capsys):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run(Evaluate(out=whole, checkpoint=home / "checkpoint", **place(home), batch_size=1, report=False))
    shown = capsys.readouterr()
    assert "frames 6/6" in shown.err
    assert {path.name for path in whole.iterdir()} == FILES
    results = read(whole / "results_nusc.json")
    assert set(results["results"]) == {f"s{s}k{k}" for s in range(2) for k in range(3)}
    assert results["meta"]["use_lidar"]
    assert 0 < len(results["results"]["s0k0"]) <= 30

    # Interrupted after two batches of two; what is done is not done again.
    args = Evaluate(out=cut, checkpoint=home / "checkpoint", **place(home), batch_size=2, report=False)
    done = []

    def interrupted(found, token, pose, classes):
        done.append(token)
        if len(done) == 5:
            raise KeyboardInterrupt
        return entries(found, token, pose, classes)

    entries = evaluate.result_entries
    monkeypatch.setattr(evaluate, "result_entries", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(args)
    assert {path.name for path in cut.iterdir()} == {"results_nusc.resume_log", ".lock"}
    run(args)
    assert len(done) == 5 + 2
    assert {path.name for path in cut.iterdir()} == FILES
    again = read(cut / "results_nusc.json")
    for token, boxes in results["results"].items():
        assert [b["detection_name"] for b in boxes] == [b["detection_name"] for b in again["results"][token]]
        for field in ("translation", "size", "detection_score"):
            ours, theirs = ([box[field] for box in found] for found in (boxes, again["results"][token]))
            np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)
    for name in ("mean_ap", "nd_score"):
        ours, theirs = (read(folder / "metrics_summary.json")[name] for folder in (whole, cut))
        assert ours == pytest.approx(theirs, abs=1e-6)


def test_a_resume_log_of_another_detector_is_not_used(home):
    detector, data = load_detector(home / "checkpoint"), NuScenes(home, VERSION)
    tokens = tuple(data.split(SPLIT))
    frames, fewer = (NuScenesFrames(data, chosen, 1, sensor=TINY) for chosen in (tokens, tokens[1:]))
    other = dataclasses.replace(detector, variables=jax.tree.map(lambda leaf: leaf + 1, detector.variables))
    runs = ((detector, frames, 1), (other, frames, 1), (detector, fewer, 1), (detector, frames, 2))
    assert len({_fingerprint(*run) for run in runs}) == len(runs)


@pytest.mark.parametrize("empty", ["truth", "results", "both"])
def test_empty_sides_are_told_in_words(home, tmp_path, capsys, empty):
    results, truth = read(home / "results.json"), read(home / "truth.json")
    if empty in ("truth", "both"):
        truth = {token: {**sample, "boxes": []} for token, sample in truth.items()}
    if empty in ("results", "both"):
        results["results"] = {token: [] for token in truth}
    (tmp_path / "r.json").write_text(json.dumps(results))
    (tmp_path / "t.json").write_text(json.dumps(truth))
    run(
        Evaluate(
            DataOptions(),
            tmp_path / "out",
            results=tmp_path / "r.json",
            ground_truth=tmp_path / "t.json",
            bootstrap=3,
        )
    )
    shown = capsys.readouterr().err
    assert ("no ground truth counts here" in shown) == (empty != "results")
    assert ("the results hold not a single box" in shown) == (empty != "truth")
    assert read(tmp_path / "out" / "metrics_summary.json")["nd_score"] == 0
    assert (tmp_path / "out" / "report.html").is_file()


def test_classes_without_truth_are_named(home, tmp_path, capsys):
    truth = read(home / "truth.json")
    for sample in truth.values():
        sample["boxes"] = [box for box in sample["boxes"] if box["detection_name"] not in ("bus", "barrier")]
    (tmp_path / "t.json").write_text(json.dumps(truth))
    run(
        Evaluate(
            DataOptions(), tmp_path, results=home / "results.json", ground_truth=tmp_path / "t.json", report=False
        )
    )
    assert re.search("no ground truth counts of .*bus.*barrier", capsys.readouterr().err)


MISTAKES = {
    "neither": ({}, "expected --checkpoint or --results"),
    "no place": ({"results": "{home}/results.json"}, "expected --data-root, or --results with --ground-truth"),
    "no such version": (
        {"results": "{home}/results.json", "data_root": "{home}", "version": "v2"},
        "v2: no such folder",
    ),
    "checkpoint and truth": (
        {"checkpoint": "x", "ground_truth": "{home}/truth.json"},
        "a checkpoint needs --data-root",
    ),
    "truth and tables": (
        {"results": "x", "ground_truth": "{home}/truth.json", "split": "val"},
        "--ground-truth: expected no data set with it",
    ),
    "no such truth": ({"results": "x", "ground_truth": "{home}/none.json"}, "none.json: no such file"),
    "no such results": (
        {"results": "{home}/none.json", "ground_truth": "{home}/truth.json"},
        "none.json: no such file",
    ),
    "other samples": (
        {"results": "{home}/results.json", "data_root": "{home}", "version": VERSION, "split": "other"},
        "split 'other': not found",
    ),
    "batch": ({"results": "x", "ground_truth": "y", "batch_size": 0}, "--batch-size: got 0, expected at least 1"),
    "bootstrap": (
        {"results": "x", "ground_truth": "y", "bootstrap": -1},
        "--bootstrap: got -1, expected at least 0",
    ),
    "no such sensor": ({"results": "x", "ground_truth": "y", "sensor": "sonar"}, "sonar: no such sensor"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named_before_anything_is_written(home, tmp_path, name):
    given, message = MISTAKES[name]
    paths = ("checkpoint", "results", "data_root", "ground_truth")
    options = {key: type(home)(value.format(home=home)) if key in paths else value for key, value in given.items()}
    data = DataOptions(**{key: options.pop(key) for key in ("data_root", "version") if key in options})
    with pytest.raises((ValueError, OSError), match=message):
        run(Evaluate(data, tmp_path / "out", **options))
    assert list(tmp_path.iterdir()) == []


def test_out_may_not_be_a_file(home, tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(ValueError, match=r"--out: .*found a file"):
        run(
            Evaluate(
                DataOptions(), tmp_path / "out", results=home / "results.json", ground_truth=home / "truth.json"
            )
        )
