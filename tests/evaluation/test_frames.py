"""Check metrics of classes other than the benchmark's against loops, and their files and reports."""

import dataclasses
import itertools
import json
import re

import numpy as np
import pytest
from made_evaluation import random_boxes
from metrics_oracle import assert_numbers, score_frames

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.examples import choose_examples, sensor_boxes
from fcos_lidar_jax.evaluation.frames import evaluate_frames, frame_columns, read_detections, write_detections
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC, evaluate, metric_of
from fcos_lidar_jax.evaluation.records import as_records
from fcos_lidar_jax.evaluation.summary import describe, warnings, write_evaluation
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.evaluation_report import Example, write_evaluation_report

OWN = ("crate/box", "traffic_cone", "fork$lift", "barrier", "never_seen")
MANY = tuple(f"kind_{k}" for k in range(150))
"""More classes than an int8 can index."""


def made(classes, used, frames=8, objects=25):
    """Frames with objects of some classes, the first without velocities, and detections near the objects."""
    rng = np.random.default_rng(0)
    truths, found = [], []
    for _ in range(frames):
        boxes = random_boxes(rng, objects)
        labels = rng.choice(used, objects).astype(np.int32)
        boxes[labels == used[0], 7:] = np.nan
        boxes[rng.random(objects) < 0.2, 8] = np.nan
        truths.append(Frame(np.zeros((0, 5), np.float32), boxes, labels, rng.integers(0, 5, objects)))
        rows = rng.choice(objects, 2 * objects)
        near = boxes[rows] + rng.normal(0, [0.7, 0.7, 0.3, 0, 0, 0, 0.5, 1, 1], (len(rows), 9)).astype(np.float32)
        guessed = np.where(rng.random(len(rows)) < 0.8, labels[rows], rng.choice(len(classes), len(rows)))
        scores = np.sort(rng.random(len(rows)).astype(np.float32))[::-1]
        guessed, valid = guessed.astype(np.int32), rng.random(len(rows)) < 0.9
        found.append(Detections(np.nan_to_num(near), scores, guessed, valid, np.int32(0)))
    return found, truths


def as_dicts(classes, boxes, labels, values, of="detection_score"):
    """Convert boxes to the input format of the oracle."""
    return [
        {
            "translation": box[:3].tolist(),
            "size": box[[4, 3, 5]].tolist(),
            "rotation": [np.cos(box[6] / 2), 0.0, 0.0, np.sin(box[6] / 2)],
            "velocity": box[7:].tolist(),
            "detection_name": classes[label],
            "attribute_name": "",
            of: value.item(),
        }
        for box, label, value in zip(boxes.astype(float), labels, values, strict=True)
    ]


@pytest.mark.parametrize(
    ("classes", "used", "ranges"),
    [(OWN, [0, 1, 2, 3], (30.0, 20.0, 70.0, 45.0, 10.0)), (MANY, [2, 149, 77, 130, 128], (40.0,) * 150)],
    ids=["own", "many"],
)
def test_all_numbers_match_loops(classes, used, ranges):
    found, truths = made(classes, used)
    summary = evaluate_frames(found, truths, metric_of(classes, ranges)).summary
    expected = score_frames(
        {i: as_dicts(classes, *(a[d.valid] for a in (d.boxes, d.labels, d.scores))) for i, d in enumerate(found)},
        {i: as_dicts(classes, f.boxes, f.labels, f.num_points, "num_pts") for i, f in enumerate(truths)},
        dict(zip(classes, ranges, strict=True)),
    )
    assert list(summary) == list(expected)
    assert summary["absent_classes"] == [name for k, name in enumerate(classes) if k not in used]
    for key in ("label_aps", "label_tp_errors"):
        assert summary[key].keys() == expected[key].keys()
    assert_numbers(summary, expected, 1e-6)
    assert "vel_err" not in summary["label_tp_errors"][classes[used[0]]]
    assert summary["mean_ap"] > 0.1


def test_truth_that_is_not_evaluated_is_reported():
    """One car is beyond its range, one contains no point, and one is evaluated."""
    boxes = np.ones((3, 9), np.float32)
    boxes[0, 0] = 6
    frame = Frame(np.zeros((0, 5), np.float32), boxes, np.zeros(3, np.int32), np.array([1, 0, 1]))
    nothing = Detections(np.zeros((0, 9)), np.zeros(0), np.zeros(0, np.int32), np.zeros(0, bool), np.int32(0))
    for near_m, num_points, expected in (
        (5.0, [1, 0, 1], ["1 of 3 boxes of the truth contain no point", "1 boxes .*beyond the range.*: car 5 m"]),
        (9.0, [0, 0, 1], ["2 of 3 boxes .*no point.*: are points and boxes in the same frame?"]),
        (9.0, [1, 1, 1], []),
    ):
        changed = dataclasses.replace(frame, num_points=np.array(num_points))
        predictions, truth = frame_columns([nothing], [changed])
        evaluation = evaluate(predictions, truth, metric_of(["car"], [near_m]))
        lines = warnings(evaluation, 1, truth)[:-1]  # the last one is about the detections
        assert len(lines) == len(expected)
        assert all(map(re.match, expected, lines))


def test_the_threshold_of_examples_takes_all_equal_scores():
    """One object is found with score 0.9, the other with 0.5, like eight boxes on nothing before it."""
    boxes = np.ones((10, 9), np.float32)
    boxes[1:9, 0] = 20
    boxes[9, 1] = 9
    frame = Frame(np.zeros((0, 5), np.float32), boxes[[0, 9]], np.zeros(2, np.int32), np.ones(2, int))
    scores = np.array([0.9] + 9 * [0.5], np.float32)
    found = Detections(boxes, scores, np.zeros(10, np.int32), np.ones(10, bool), np.int32(0))
    chosen = choose_examples(evaluate_frames([found], [frame], metric_of(["car"])))
    assert chosen.min_score == np.float32(0.9)  # F1 is 2 / 3, and 4 / 12 of all


def test_invalid_metrics_are_rejected():
    for classes, ranges, message in (
        ((), (), "ranges_m: got .*expected a positive length for each of at least one class"),
        (("a", "b"), (1.0, 0.0), "ranges_m: got .*expected a positive length"),
        (("a", "b"), (1.0,), "shorter"),
        (("a", "b", "a"), (), "classes: got .*expected different names"),
    ):
        with pytest.raises(ValueError, match=message):
            metric_of(classes, ranges)
    with pytest.raises(ValueError, match="metric: got the nuScenes benchmark's"):
        evaluate_frames([], [], NUSCENES_METRIC)


def test_without_truth_there_is_no_score_and_intervals_stay_defined(tmp_path):
    found, truths = made(OWN, [0, 1], frames=2)
    empty = [dataclasses.replace(frame, num_points=frame.num_points * 0) for frame in truths]
    evaluation = evaluate_frames(found, empty, metric_of(OWN))
    assert np.isnan(evaluation.summary["mean_ap"])
    assert evaluation.summary["absent_classes"] == list(OWN)
    assert warnings(evaluation, 3) == ["no ground truth is evaluated: no score"]
    write_evaluation(tmp_path, evaluation, {}, repeats=3)
    write_evaluation_report(tmp_path, title="t", num_samples=2, examples=(), sensor=TINY)
    assert "<td>–</td>" in (tmp_path / "report.html").read_text()
    # Only one of two frames has truth. Resampled sets without this frame must not break the interval.
    half = evaluate_frames(found, [truths[0], empty[1]], metric_of(OWN))
    drawn = bootstrap(half, repeats=40)
    assert set(drawn) == {"repeats", "seed", "level", "mean_ap"}
    assert 0 < drawn["mean_ap"]["low"] <= half.summary["mean_ap"] <= drawn["mean_ap"]["high"]


def test_all_resampled_sets_are_scored_over_the_same_classes():
    """One class is detected equally well in all frames; another one occurs in two frames and is never detected."""
    found, truths = made(OWN, [0], frames=12)
    rare = dataclasses.replace(truths[0], labels=np.ones_like(truths[0].labels))
    missed = dataclasses.replace(found[0], valid=np.zeros_like(found[0].valid))
    evaluation = evaluate_frames([*found, missed, missed], [*truths, rare, rare], metric_of(OWN))
    assert [*evaluation.summary["mean_dist_aps"].values()][1] == 0
    drawn = bootstrap(evaluation, repeats=60)["mean_ap"]
    ap = evaluation.summary["mean_dist_aps"][OWN[0]]
    assert drawn["high"] < 0.75 * ap  # sets without the second class must not score the AP of the first class


def test_groups_of_samples_are_drawn_together():
    found, truths = made(OWN, [0, 1], frames=6)
    groups = [0, 0, 1, 1, 2, 2]
    evaluation = evaluate_frames(found, truths, metric_of(OWN))
    drawn = bootstrap(evaluation, repeats=50, groups=groups)["mean_ap"]
    possible = []
    for drawn_groups in itertools.product(range(3), repeat=3):
        rows = [row for group in drawn_groups for row in (2 * group, 2 * group + 1)]
        again = evaluate_frames([found[r] for r in rows], [truths[r] for r in rows], metric_of(OWN))
        possible.append(again.summary["mean_ap"])
    assert min(possible) - 1e-9 <= drawn["low"] < drawn["high"] <= max(possible) + 1e-9
    assert drawn != bootstrap(evaluation, repeats=50)["mean_ap"]
    one = bootstrap(evaluation, repeats=5, groups=[0] * 6)["mean_ap"]
    assert one["low"] == one["high"] == pytest.approx(evaluation.summary["mean_ap"])


def test_scores_and_warnings_name_the_metric():
    found, truths = made(OWN, [0, 1])
    evaluation = evaluate_frames(found, truths, metric_of(OWN))
    lines = describe(evaluation, bootstrap(evaluation, repeats=20)).splitlines()
    assert lines[0] == f"mAP by centre distance {evaluation.summary['mean_ap']:.4f}  on 8 frames"
    assert lines[1].startswith("trans_err ")
    assert re.fullmatch(r"95% intervals over samples: mAP by centre distance 0\.\d+ to 0\.\d+", lines[2])
    header, crate, cone = (line.split() for line in lines[3:])
    assert header == ["class", "AP", *evaluation.summary["tp_errors"]]
    assert crate[:2] == [OWN[0], f"{evaluation.summary['mean_dist_aps'][OWN[0]]:.4f}"]
    assert cone[header.index("orient_err")] == "-"
    absent = ", ".join(OWN[2:])
    assert warnings(evaluation, 9) == [f"no ground truth is evaluated for {absent}: excluded from the means"]
    invalid = [dataclasses.replace(d, valid=d.valid & False) for d in found]
    nothing = evaluate_frames(invalid, truths, metric_of(OWN))
    assert "contain no boxes" in warnings(nothing, 0)[1]
    assert "within the range" in warnings(nothing, 5)[1]


NAMES = [f"frame {i}" for i in range(8)]


def test_written_detections_are_read_back(tmp_path):
    found, _ = made(OWN, [0, 1])
    file = tmp_path / "detections.json"
    lines = [json.dumps(as_records(one, OWN)).encode() for one in found]
    write_detections(file, zip(NAMES, lines, strict=True), OWN)
    written = json.loads(file.read_text())
    assert written["classes"] == list(OWN)
    assert [frame["name"] for frame in written["frames"]] == NAMES
    again = read_detections(file, NAMES[::-1], OWN[::-1])[::-1]
    for one, back in zip(found, again, strict=True):
        for read, wrote in ((back.boxes, one.boxes), (back.scores, one.scores), (4 - back.labels, one.labels)):
            np.testing.assert_array_equal(read, wrote[one.valid])
        assert back.valid.all()
    box = {"label": "barrier", "score": 0.5, "box": [0, 0, 0, 1, 1, 1, 0, None, None]}
    file.write_text(json.dumps({"frames": [{"name": "a", "boxes": [box]}]}))
    assert np.isnan(read_detections(file, ["a"], OWN)[0].boxes[0, 7:]).all()


def one_box(label="barrier", score=1, size=1):
    return {"label": label, "score": score, "box": [size] * 9}


@pytest.mark.parametrize(
    ("names", "boxes", "message"),
    [
        ("a", [], "sample b: missing"),
        ("abc", [], "sample c: not expected: expected the 2 samples"),
        ("aba", [], "frame a: occurs twice"),
        ("ab", [{}], "label"),
        ("ab", [one_box("x")], "frame b: box 0: label: got 'x', expected one of crate/box, traffic_cone"),
        ("ab", [one_box(size=1e300)], r"frame b: box 0: box: got .*expected numbers of at most 1e\+08"),
        ("ab", [one_box(size=1e-300)], "frame b: box 0: box: got .*expected three positive sizes"),
        ("ab", [one_box(score=-1)], "frame b: box 0: score: got -1.0, expected a number of at least 0"),
    ],
)
def test_invalid_detections_are_named(names, boxes, message, tmp_path):
    file = tmp_path / "detections.json"
    entries = [{"name": name, "boxes": boxes if name == "b" else []} for name in names]
    file.write_text(json.dumps({"frames": entries}))
    with pytest.raises(ValueError, match=f"^{re.escape(str(file))}: .*{message}"):
        read_detections(file, ["a", "b"], OWN)


@pytest.mark.slow
def test_files_and_report_of_own_classes(tmp_path):
    """Uses class names that are invalid file names, and classes without truth."""
    found, truths = made(OWN, [0, 2])
    evaluation = evaluate_frames(found, truths, metric_of(OWN))
    write_evaluation(tmp_path, evaluation, {}, repeats=5)
    chosen = choose_examples(evaluation)
    row = chosen.rows["best"]
    boxes = sensor_boxes(evaluation, row, np.eye(4), min_score=chosen.min_score)
    kept, seen = found[row], boxes[0][0]
    shown = kept.valid & (kept.scores >= chosen.min_score) & (np.hypot(*kept.boxes[:, :2].T) < 30)
    off = seen[np.hypot(*seen[:, :2].T) < 30] - kept.boxes[shown]
    off[:, 6] = (off[:, 6] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(off, 0, atol=1e-5)
    cloud = np.random.default_rng(0).normal(0, 5, (50, 5)).astype(np.float32)
    example = Example("best", NAMES[row], cloud, *boxes)
    write_evaluation_report(tmp_path, title="t", num_samples=8, examples=[example], sensor=TINY)
    text = (tmp_path / "metrics_summary.json").read_text()
    assert "NaN" not in text
    summary = json.loads(text)
    curves = json.loads((tmp_path / "curves.json").read_text())["classes"]
    assert list(curves) == [OWN[0], OWN[2]]
    assert "attr_err" not in curves[OWN[0]]["errors"]
    page = re.sub(r'src="data:[^"]*"', "src", (tmp_path / "report.html").read_text())
    assert page.count("<img") == 2 * 2 + 2
    assert "not the nuScenes benchmark" in page
    assert "Without truth here: traffic cone, barrier, never seen." in page
    cells = dict(re.findall(r'<th scope="row">([^<]*)</th><td>([^<]*)</td>', page))
    assert cells["mAP by centre distance"] == f"{summary['mean_ap']:.3f}"
    assert cells["mAP by centre distance, 95% interval"].count("0.") == 2
    lifts = int((evaluation.truth.label == OWN.index("fork$lift")).sum())
    assert cells["fork$lift"] == f"{lifts}" != "0"
    with pytest.raises(KeyboardInterrupt):
        write_evaluation(tmp_path, evaluation, {}, repeats=5, report=interrupt)
    assert not (tmp_path / "bootstrap.json").exists(), "it would be of other scores"


def interrupt(done):
    raise KeyboardInterrupt
