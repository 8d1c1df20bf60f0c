"""Check matching against values calculated by hand."""

import numpy as np

from experiments.studies.overfit_keyframe import match_frame
from fcos_lidar_jax.evaluation.matching import candidate_pairs, heading_error
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC

CAR, CONE, BARRIER = (NUSCENES_METRIC.classes.index(c) for c in ("car", "traffic_cone", "barrier"))


def box(x, y, yaw=0.0):
    return [x, y, 0, 4, 2, 1, yaw, 0, 0]


def test_matching_is_one_to_one_by_score_and_nearest_first():
    truth = np.array([box(0, 0), box(1, 0)])
    boxes = np.array([box(0.6, 0), box(0.1, 0), box(0.2, 0)])
    scores, labels = np.array([0.5, 0.9, 0.8]), np.zeros(3, int)
    match = match_frame(boxes, labels, scores, truth, labels[:2], max_distance_m=1.0)
    assert dict(zip(match.detection.tolist(), match.truth.tolist(), strict=True)) == {1: 0, 2: 1}
    np.testing.assert_allclose(match.distance_m, [0.1, 0.8])


def test_matching_excludes_the_limit_and_respects_classes_and_headings():
    truth, labels = np.array([box(0, 0)]), np.array([CAR])
    args = np.array([0.9]), truth, labels
    assert len(match_frame(np.array([box(0.5, 0)]), labels, *args, max_distance_m=0.5).truth) == 0
    assert len(match_frame(np.array([box(0.4, 0)]), np.array([CONE]), *args, max_distance_m=0.5).truth) == 0
    limits = {"max_distance_m": 0.5, "max_heading_error_rad": 0.1}
    cases = ((np.pi, None, 0), (np.pi, np.pi, 1), (np.pi, 0.0, 1), (np.pi, 2 * np.pi, 0))
    for yaw, period, hits in ((0.2, None, 0), *cases):
        limits["heading_period_rad"] = None if period is None else np.array([period])
        assert len(match_frame(np.array([box(0, 0, yaw)]), labels, *args, **limits).truth) == hits


def test_the_heading_error_is_taken_modulo_the_period_of_the_class():
    labels = [CAR, BARRIER, BARRIER, CONE, CAR]
    differences = np.array([np.pi, np.pi, 2.0, 1.0, 2 * np.pi + 0.1])
    error = heading_error(differences, np.zeros(5), NUSCENES_METRIC.heading_period_rad[labels])
    np.testing.assert_allclose(error, [np.pi, 0, np.pi - 2.0, 0, 0.1], atol=1e-9)


def test_pairs_match_a_double_loop(monkeypatch):
    monkeypatch.setattr("fcos_lidar_jax.evaluation.matching._BLOCK", 50)  # many blocks
    rng = np.random.default_rng(0)
    group, true_group = rng.integers(0, 6, 90), rng.integers(0, 6, 40)
    # Centres on a grid give equal distances and distances at the limit.
    centres, true_centres = (rng.integers(0, 6, (n, 2)).astype(float) for n in (90, 40))
    pairs = candidate_pairs(group, centres, true_group, true_centres, max_distance_m=3.0)
    expected = []
    for d in range(90):
        near = [(np.hypot(*(centres[d] - true_centres[t])), t) for t in range(40) if group[d] == true_group[t]]
        expected += [(d, t, distance) for distance, t in sorted(near) if distance < 3]
    assert list(zip(pairs.detection.tolist(), pairs.truth.tolist(), strict=True)) == [e[:2] for e in expected]
    np.testing.assert_allclose(pairs.distance_m, [e[2] for e in expected])
