"""Check the detection metric against the official unit test, values by hand and loops, and in empty cases."""

import random

import numpy as np
import pytest
from made_evaluation import make_task, truth_of
from metrics_oracle import assert_numbers, score, turned, yaw

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.evaluation import evaluate_detections, metrics
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.boxes import ATTRIBUTE_INDEX, CLASS_ATTRIBUTES, heading_yaw, make_columns
from fcos_lidar_jax.evaluation.examples import choose_examples
from fcos_lidar_jax.evaluation.matching import rank
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC, average_precision, class_curves, evaluate
from fcos_lidar_jax.evaluation.results import read_results
from fcos_lidar_jax.evaluation.truth import read_truth
from fcos_lidar_jax.geometry import rotation_matrix


def ranked(found, truth):
    """Return one ranking per class, with two metres in place of all four distances."""
    return rank(found, truth, heading_period_rad=NUSCENES_METRIC.heading_period_rad, distances_m=(2.0,) * 4)


def columns(rows):
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return make_columns(yaw=heading_yaw(table.pop("rotation").astype(float)), **table)


def official_boxes():
    """Random boxes of the devkit's unit test of the score."""
    random.seed(42)
    numpy_draws = np.random.RandomState(42)
    truth, found = [], []
    for label, name in enumerate(NUSCENES_CLASSES):
        for boxes, each, reach in ((truth, 3, 15), (found, 25, 10)):
            for sample in np.repeat(np.arange(30), each):
                boxes.append(official_box(numpy_draws, sample, label, sorted(CLASS_ATTRIBUTES[name]), reach))
    return columns(truth), columns(found)


def official_box(draws, sample, label, attributes, reach):
    box = {"sample": sample, "label": label, "translation": [*(draws.rand(2) * reach), 0.0]}
    box |= {"size": draws.rand(3) * 4, "rotation": draws.rand(4), "velocity": draws.rand(3)[:2] * 4}
    box["score"] = random.random()
    box["attribute"] = ATTRIBUTE_INDEX[attributes[draws.randint(0, len(attributes))]] if attributes else -1
    random.random()
    return box


def test_the_score_matches_the_official_unit_test():
    truth, found = official_boxes()
    _, summary = metrics.score(ranked(found, truth), NUSCENES_METRIC)
    assert abs(summary["nd_score"] - 0.08606662159639042) < 1e-12


def cars(*rows):
    """Cars at x with a score, or a box of another class if there are no cars."""
    still = {"sample": 0, "size": [2.0] * 3, "rotation": [1, 0, 0, 0], "velocity": [0, 0], "attribute": -1}
    boxes = [{**still, "label": 0, "score": score, "translation": [x, 0, 0]} for x, score in rows]
    return columns(boxes or [{**still, "label": 1, "score": 0.5, "translation": [0, 0, 0]}])


@pytest.mark.parametrize(
    ("truth", "found", "expected"),
    [
        ([0], [(0, 0.9)], 1.0),
        ([0, 30], [(0, 0.9)], 0.4 / 0.9),
        # A false positive ranks first, so precision is half the recall. The official test expects the area of the
        # triangle, ((0.8 * 0.4) / 2) / (0.9 * 0.9); the sum over 90 recalls approximates it.
        ([0], [(30, 0.9), (0, 0.8)], sum(max(r / 200 - 0.1, 0) for r in range(11, 101)) / 90 / 0.9),
        ([], [(0, 0.9)], 0.0),
        ([0], [], 0.0),
        # The matching distance is exclusive.
        ([0], [(2.0, 0.9)], 0.0),
        ([0], [(np.nextafter(2.0, 0), 0.9)], 1.0),
        # Of two boxes on one truth, the second is a false positive at full recall.
        ([0], [(0, 0.9), (0.1, 0.8)], (89 * 0.9 + 0.4) / 90 / 0.9),
        # The later box wins among equal scores.
        ([0], [(9, 0.5), (0, 0.5)], (89 * 0.9 + 0.4) / 90 / 0.9),
        ([0], [(0, 0.5), (9, 0.5)], sum(max(r / 200 - 0.1, 0) for r in range(11, 101)) / 90 / 0.9),
    ],
)
def test_single_class_values(truth, found, expected):
    ranking = ranked(cars(*found), cars(*((x, -1.0) for x in truth)))[0]
    assert average_precision(class_curves(ranking).precision[2]) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("number", "expected"), [(9, 0.3), (10, 1.0)])
def test_errors_require_a_recall_above_a_tenth(number, expected):
    curves = class_curves(ranked(cars((0.3, 0.9)), cars(*((20.0 * i, -1.0) for i in range(number))))[0])
    assert metrics.mean_error(curves.errors[0], curves.confidence[2]) == pytest.approx(expected)


@pytest.mark.parametrize(("near", "expected"), [([-1, 1], 0), ([1, -1], 0.75)])
def test_the_first_truth_wins_among_equal_distances(near, expected):
    """The truth at x = 1 is four times as wide as the detection."""
    truth = cars(*((x, -1.0) for x in near))
    truth.size[near.index(1), 0] *= 4
    ranking = ranked(cars((0, 0.9)), truth)[0]
    assert ranking.hit.all()
    assert ranking.errors[1, 0] == pytest.approx(expected)


@pytest.mark.parametrize(("seed", "ties"), [(0, True), (1, False), (2, True), (3, False)])
def test_all_numbers_match_loops(seed, ties):
    tables, results = make_task(seed, ties=ties, absent=("bus", "traffic_cone") if seed == 3 else ())
    truth = truth_of(tables)
    assert_numbers(evaluate_detections(results, truth), score(results["results"], truth))


def task(seed=0, **options):
    tables, results = make_task(seed, **options)
    return results, truth_of(tables)


def test_all_numbers_are_defined_without_truth_or_predictions():
    results, truth = task()
    no_truth = {token: {**sample, "boxes": []} for token, sample in truth.items()}
    nothing = {**results, "results": {token: [] for token in truth}}
    one = next(iter(truth))
    only = {**results, "results": {one: []}}, {one: truth[one]}
    for found, true in ((results, no_truth), (nothing, truth), (nothing, no_truth), only):
        summary = evaluate_detections(found, true)
        assert summary["nd_score"] == summary["mean_ap"] == 0
        assert set(summary["tp_errors"].values()) == {1.0}
        assert np.isnan(summary["label_tp_errors"]["traffic_cone"]["orient_err"])


def test_numpy_numbers_and_arrays_are_accepted():
    plain, truth = task()
    arrays = {
        token: [{**box, "size": np.array(box["size"]), "velocity": np.array(box["velocity"])} for box in boxes]
        for token, boxes in plain["results"].items()
    }
    scores = [evaluate_detections(each, truth)["nd_score"] for each in (plain, {**plain, "results": arrays})]
    assert scores[0] == scores[1]


def test_yaw_and_axes_of_quaternions_of_any_norm():
    rotation = np.random.default_rng(0).normal(0, 2, (20, 4))
    for q, angle, axes in zip(rotation, heading_yaw(rotation), rotation_matrix(rotation), strict=True):
        assert angle == pytest.approx(yaw({"rotation": q}))
        np.testing.assert_allclose(axes.T, [turned(q, unit) for unit in np.eye(3)], atol=1e-12)


def evaluated(results, truth):
    read = read_truth(truth)
    return evaluate(read_results(results, read.tokens).boxes, read)


@pytest.fixture(scope="module")
def larger():
    return evaluated(*task(1, samples=10, objects=40))


def test_a_resampled_set_has_the_score_of_copied_samples():
    results, truth = task(2, ties=False)
    evaluation = evaluated(results, truth)
    copies = np.random.default_rng(0).integers(0, 3, len(truth))
    _, ours = metrics.score([r.resampled(copies) for r in evaluation.rankings], NUSCENES_METRIC)
    names = {f"{token}-{i}": token for token, n in zip(evaluation.tokens, copies, strict=True) for i in range(n)}
    found, true = ({name: boxes[token] for name, token in names.items()} for boxes in (results["results"], truth))
    assert_numbers(ours, score(found, true))


def test_bootstrap_intervals_contain_the_score_and_depend_only_on_the_seed(larger):
    first, again, other = (bootstrap(larger, repeats=20, seed=s) for s in (0, 0, 1))
    assert first == again != other
    for key in ("mean_ap", "nd_score"):
        assert first[key]["low"] < larger.summary[key] < first[key]["high"]


def test_examples_are_ordered_by_quality(larger):
    chosen = choose_examples(larger)
    shown = {}
    for name, row in chosen.rows.items():
        hits = boxes = 0
        for ranking in larger.rankings:
            confident = (ranking.sample == row) & (ranking.score >= chosen.min_score)
            hits += (ranking.hit[2] & confident).sum()
            boxes += confident.sum() + (ranking.truth_sample == row).sum()
        shown[name] = 2 * hits / boxes
    assert shown["best"] > shown["typical"] > shown["worst"]
    assert chosen.extremes["worst 1"] == chosen.rows["worst"]
    assert chosen.extremes["best 1"] == chosen.rows["best"]
    assert [*chosen.extremes] == [f"{kind} {place}" for kind in ("worst", "best") for place in (1, 2, 3)]
    assert len(set(chosen.extremes.values())) == 6
    results, truth = task(1)
    few = {token: sample if i < 4 else {**sample, "boxes": []} for i, (token, sample) in enumerate(truth.items())}
    assert [*choose_examples(evaluated(results, few)).extremes] == ["worst 1", "worst 2", "worst 3", "best 1"]
    results, truth = task()
    nothing = {token: {**sample, "boxes": []} for token, sample in truth.items()}
    assert choose_examples(evaluated(results, nothing)).rows == {}
