"""The detection metric: the official unit-test value, values by hand, plain loops as oracle, empty cases."""

import math
import random

import metrics_oracle
import numpy as np
import pytest
from made_evaluation import RACK, make_task, truth_of

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation import evaluate_detections
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.boxes import (
    ATTRIBUTE_INDEX,
    CLASS_ATTRIBUTES,
    BoxColumns,
    heading_yaw,
)
from fcos_lidar_jax.evaluation.examples import choose_examples
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.matching import rank
from fcos_lidar_jax.evaluation.metrics import (
    DISTANCES_M,
    NUSCENES_METRIC,
    average_precision,
    class_curves,
    evaluate,
    mean_error,
    metric_of,
    summarise,
)
from fcos_lidar_jax.evaluation.results import read_results
from fcos_lidar_jax.evaluation.truth import read_truth
from fcos_lidar_jax.geometry import rotation_matrix
from fcos_lidar_jax.types import Detections

CLASSES = NUSCENES_METRIC.classes
TWO_METRES = dict(heading_period_rad=NUSCENES_METRIC.heading_period_rad, distances_m=(2.0,) * 4, error_row=2)


def columns(rows):
    names = ("sample", "label", "translation", "size", "rotation", "velocity", "score", "attribute")
    kinds = (int, int, float, float, float, float, float, int)
    sample, label, translation, size, rotation, velocity, score, attribute = (
        np.array([row[name] for row in rows], kind) for name, kind in zip(names, kinds, strict=True)
    )
    yaw = heading_yaw(rotation)
    return BoxColumns(sample, label, translation, size, yaw, velocity, attribute, score, np.full(len(rows), -1))


def official_boxes():
    """The random boxes of the devkit's own test of the score."""
    random.seed(42)
    numpy_draws = np.random.RandomState(42)
    truth, found = [], []
    for label, name in enumerate(CLASSES):
        for boxes, each, reach in ((truth, 3, 15), (found, 25, 10)):
            for sample in range(30):
                for _ in range(each):
                    boxes.append(official_box(numpy_draws, sample, label, sorted(CLASS_ATTRIBUTES[name]), reach))
    return columns(truth), columns(found)


def official_box(draws, sample, label, attributes, reach):
    box = {"sample": sample, "label": label, "translation": [*(draws.rand(2) * reach), 0.0]}
    box |= {"size": draws.rand(3) * 4, "rotation": draws.rand(4), "velocity": draws.rand(3)[:2] * 4}
    box["score"] = random.random()
    box["attribute"] = ATTRIBUTE_INDEX[attributes[draws.randint(0, len(attributes))]] if attributes else -1
    random.random()
    return box


def test_the_official_value():
    truth, found = official_boxes()
    rankings = rank(found, truth, **TWO_METRES)
    curves = {name: class_curves(ranking) for name, ranking in zip(CLASSES, rankings, strict=True)}
    assert abs(summarise(curves, NUSCENES_METRIC)["nd_score"] - 0.08606662159639042) < 1e-12


def cars(*rows):
    """Cars at x with a score."""
    still = {"translation": [0.0, 0, 0], "size": [2.0, 4, 1.5], "rotation": [1.0, 0, 0, 0], "velocity": [0.0, 0]}
    boxes = [
        {**still, "sample": 0, "label": 0, "attribute": -1, "score": s, "translation": [x, 0, 0]} for x, s in rows
    ]
    return (
        columns(boxes) if boxes else columns([{**still, "sample": 0, "label": 1, "attribute": -1, "score": 0.5}])
    )


@pytest.mark.parametrize(
    ("truth", "found", "expected"),
    [
        ([0], [(0, 0.9)], 1.0),
        ([0, 30], [(0, 0.9)], 0.4 / 0.9),
        # A false positive first: precision is half the recall; officially ((0.8 * 0.4) / 2) / (0.9 * 0.9), the
        # triangle of which 90 recalls are these bars.
        ([0], [(30, 0.9), (0, 0.8)], sum(max(r / 200 - 0.1, 0) for r in range(11, 101)) / 90 / 0.9),
        ([], [(0, 0.9)], 0.0),
        ([0], [], 0.0),
        # Two metres are two metres away, not nearer.
        ([0], [(2.0, 0.9)], 0.0),
        ([0], [(np.nextafter(2.0, 0), 0.9)], 1.0),
        # Two boxes on one truth: the curve ends in the second, a false positive, at full recall.
        ([0], [(0, 0.9), (0.1, 0.8)], (89 * 0.9 + 0.4) / 90 / 0.9),
    ],
)
def test_single_class_values(truth, found, expected):
    rankings = rank(cars(*found), cars(*((x, -1.0) for x in truth)), **TWO_METRES)
    assert average_precision(class_curves(rankings[0]).precision[2]) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("number", "expected"), [(9, 0.3), (10, 1.0), (11, 1.0)])
def test_errors_count_from_a_recall_above_a_tenth(number, expected):
    truth = cars(*((20.0 * i, -1.0) for i in range(number)))
    curves = class_curves(rank(cars((0.3, 0.9)), truth, **TWO_METRES)[0])
    assert mean_error(curves.errors[0], curves.confidence[2]) == pytest.approx(expected)


def test_of_equal_scores_the_later_box_comes_first():
    truth = cars((0, -1.0))
    first, last = (
        class_curves(rank(cars(*found), truth, **TWO_METRES)[0])
        for found in ([(0, 0.5), (9, 0.5)], [(9, 0.5), (0, 0.5)])
    )
    assert average_precision(last.precision[2]) > average_precision(first.precision[2])


def test_of_equal_distances_the_first_truth_is_taken():
    found = cars((0, 0.9))
    for near in ([-1, 1], [1, -1]):
        ranking = rank(found, cars(*((x, -1.0) for x in near)), **TWO_METRES)[0]
        assert ranking.hit.all()
    pair = columns(
        [
            {"sample": 0, "label": 0, "translation": [x, 0, 0], "size": [size] * 3, "rotation": [1, 0, 0, 0],
             "velocity": [0, 0], "score": -1.0, "attribute": -1}
            for x, size in ((-1, 1.0), (1, 2.0))
        ]
    )  # fmt: skip
    error = rank(found, pair, **TWO_METRES)[0].errors[1, 0]
    assert error == pytest.approx(1 - 1 / (12 + 1 - 1))


def assert_summary(ours, theirs):
    for key in ("label_aps", "label_tp_errors"):
        for name, row in theirs[key].items():
            for field, value in row.items():
                assert ours[key][name][field] == pytest.approx(value, abs=1e-9, nan_ok=True), (key, name, field)
    for field, value in theirs["tp_errors"].items():
        assert ours["tp_errors"][field] == pytest.approx(value, abs=1e-9)
    assert ours["mean_ap"] == pytest.approx(theirs["mean_ap"], abs=1e-9)
    assert ours["nd_score"] == pytest.approx(theirs["nd_score"], abs=1e-9)


@pytest.mark.parametrize("ties", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_every_number_is_that_of_plain_loops(seed, ties):
    tables, results = make_task(seed, ties=ties, absent=("bus", "traffic_cone") if seed == 3 else ())
    truth = truth_of(tables)
    assert_summary(evaluate_detections(results, truth), metrics_oracle.score(results["results"], truth))


def test_the_tasks_hold_every_case():
    """Else the comparisons with the loops and the devkit would show less than they claim."""
    seen = {"in a rack": 0, "beyond": 0, "no points": 0, "velocity": 0, "attribute": 0, "tie": 0, "empty": 0}
    for seed in range(4):
        tables, results = make_task(seed)
        truth = truth_of(tables)
        for token, boxes in results["results"].items():
            there = truth[token]["boxes"]
            racks = [box for box in there if box["detection_name"] == RACK]
            for box in [*boxes, *there]:
                cycle = box["detection_name"] in ("bicycle", "motorcycle")
                seen["in a rack"] += cycle and any(metrics_oracle.in_rack(box, rack) for rack in racks)
                seen["no points"] += box.get("num_pts") == 0
                seen["velocity"] += box["velocity"] is None
                seen["attribute"] += "num_pts" in box and not box["attribute_name"]
            seen["beyond"] += len(there) - len(racks) > len(
                metrics_oracle.kept([b for b in there if b not in racks], truth[token]["ego_translation"], [])
            )
            scores = [box["detection_score"] for box in boxes]
            seen["tie"] += len(set(scores)) < len(scores)
            seen["empty"] += not boxes
    assert min(seen.values()) > 0, seen


def task(seed=0, **options):
    tables, results = make_task(seed, **options)
    return results, truth_of(tables)


def test_without_truth_or_predictions_everything_is_defined():
    results, truth = task()
    no_truth = {token: {**sample, "boxes": []} for token, sample in truth.items()}
    nothing = {**results, "results": {token: [] for token in truth}}
    one = next(iter(truth))
    for found, true in (
        (results, no_truth),
        (nothing, truth),
        (nothing, no_truth),
        ({**results, "results": {one: []}}, {one: truth[one]}),
    ):
        summary = evaluate_detections(found, true)
        assert summary["nd_score"] == summary["mean_ap"] == 0
        assert set(summary["tp_errors"].values()) == {1.0}
        assert math.isnan(summary["label_tp_errors"]["traffic_cone"]["orient_err"])


def test_perfect_detections_have_the_highest_score():
    results, truth = task(1, samples=12, objects=90)
    perfect = {
        token: [
            {**box, "sample_token": token, "detection_score": 1.0, "velocity": box["velocity"] or [0.0, 0.0]}
            for box in sample["boxes"]
            if box["detection_name"] != RACK and box["num_pts"]
        ]
        for token, sample in truth.items()
    }
    summary = evaluate_detections({**results, "results": perfect}, truth)
    assert summary["nd_score"] == pytest.approx(1)


def test_500_boxes_in_every_sample():
    results, truth = task()
    box = next(boxes[0] for boxes in results["results"].values() if boxes)
    full = {
        token: [{**box, "sample_token": token, "detection_score": i / 500} for i in range(500)] for token in truth
    }
    summary = evaluate_detections({**results, "results": full}, truth)
    assert_summary(summary, metrics_oracle.score(full, truth))


def test_numpy_numbers_and_arrays_are_welcome():
    results, truth = task()
    for boxes in results["results"].values():
        for box in boxes:
            box["translation"] = np.array(box["translation"])
            box["detection_score"] = np.float64(box["detection_score"])
    plain, _ = task()
    assert evaluate_detections(results, truth)["nd_score"] == evaluate_detections(plain, truth)["nd_score"]


def test_yaw_and_axes_of_quaternions_of_any_length():
    rng = np.random.default_rng(0)
    rotation = rng.normal(0, 2, (20, 4))
    for q, yaw, axes in zip(rotation, heading_yaw(rotation), rotation_matrix(rotation), strict=True):
        assert yaw == pytest.approx(metrics_oracle.yaw({"rotation": q.tolist()}))
        for k, unit in enumerate(np.eye(3)):
            np.testing.assert_allclose(axes[:, k], metrics_oracle.turned(q.tolist(), unit), atol=1e-12)


def evaluated(seed=0, **options):
    results, truth = task(seed, **options)
    read = read_truth(truth)
    return evaluate(read_results(results, read.tokens).boxes, read), read, results, truth


def test_a_resampled_set_is_scored_as_if_its_samples_had_been_copied():
    evaluation, read, results, truth = evaluated(2, ties=False)
    copies = np.random.default_rng(0).integers(0, 3, len(read.tokens))
    rankings = [r.resampled(copies, error_row=DISTANCES_M.index(2.0)) for r in evaluation.rankings]
    curves = {name: class_curves(r) for name, r in zip(CLASSES, rankings, strict=True)}
    ours = summarise(curves, NUSCENES_METRIC)
    found, true = {}, {}
    for token, times in zip(read.tokens, copies, strict=True):
        for i in range(times):
            true[f"{token}-{i}"] = truth[token]
            found[f"{token}-{i}"] = [{**b, "sample_token": f"{token}-{i}"} for b in results["results"][token]]
    assert_summary(ours, metrics_oracle.score(found, true))


def test_bootstrap_intervals_hold_the_score_and_depend_on_the_seed_alone():
    evaluation, *_ = evaluated(1, samples=10, objects=80)
    first, again, other = (bootstrap(evaluation, repeats=60, seed=s) for s in (0, 0, 1))
    assert first == again != other
    for key in ("mean_ap", "nd_score"):
        assert first[key]["low"] < evaluation.summary[key] < first[key]["high"]
    single = evaluated(0, samples=1)[0]
    alone = single.rankings[0].resampled(np.array([2, 0]), error_row=2)
    assert len(alone.truth_sample) == 2 * (single.rankings[0].truth_sample == 0).sum()


def test_examples_run_from_best_to_worst():
    evaluation, *_ = evaluated(1, samples=10, objects=80)
    chosen = choose_examples(evaluation)
    shown = {}
    for name, row in chosen.rows.items():
        hits = misses = lost = 0
        for ranking in evaluation.rankings:
            confident = (ranking.sample == row) & (ranking.score >= chosen.min_score)
            hits += (ranking.hit[2] & confident).sum()
            misses += (~ranking.hit[2] & confident).sum()
            lost += (ranking.truth_sample == row).sum()
        shown[name] = 2 * hits / (hits + misses + lost)
    assert shown["best"] > shown["typical"] > shown["worst"]
    results, truth = task()
    nothing = read_truth({token: {**sample, "boxes": []} for token, sample in truth.items()})
    assert choose_examples(evaluate(read_results(results, nothing.tokens).boxes, nothing)).rows == {}


def test_frames_are_evaluated_in_the_sensor_frame():
    boxes = np.array([[10, 0, 0, 4, 2, 1.5, 0.3, 1, 0], [0, 60, 0, 4, 2, 1.5, 0, 0, 0]], np.float32)
    labels = np.array([0, 0])
    frame = Frame(np.zeros((0, 5), np.float32), boxes, labels, np.array([5, 5]))
    turned = boxes + np.array([0, 0.6, 0, 0, 0, 0, 0.2, 0, 0], np.float32)
    found = Detections(turned, np.array([0.9, 0.8]), labels, np.array([True, True]), np.zeros(()))
    summary = evaluate_frames([found], [frame], metric_of(CLASSES)).summary
    # The second is beyond the range of its class; the first is 0.6 m away.
    assert summary["label_aps"]["car"] == pytest.approx({"0.5": 0, "1.0": 1, "2.0": 1, "4.0": 1})
    errors = summary["label_tp_errors"]["car"]
    assert errors["trans_err"] == pytest.approx(0.6, abs=1e-6)
    assert errors["orient_err"] == pytest.approx(0.2, abs=1e-6)
    assert errors["scale_err"] == pytest.approx(0, abs=1e-6)
