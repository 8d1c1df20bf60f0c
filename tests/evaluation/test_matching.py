"""Check matching against values calculated by hand."""

import numpy as np

from experiments.studies.overfit_keyframe import match_frame
from fcos_lidar_jax.evaluation.matching import candidate_pairs


def box(x, y, yaw=0.0):
    return [x, y, 0, 4, 2, 1, yaw, 0, 0]


def test_matching_excludes_the_limit_and_respects_classes_and_headings():
    truth, labels = np.array([box(0, 0)]), np.array([0])
    args = np.array([0.9]), truth, labels
    assert len(match_frame(np.array([box(0.5, 0)]), labels, *args, max_distance_m=0.5).truth) == 0
    assert len(match_frame(np.array([box(0.4, 0)]), np.array([1]), *args, max_distance_m=0.5).truth) == 0
    limits = {"max_distance_m": 0.5, "max_heading_error_rad": 0.1}
    cases = ((np.pi, None, 0), (np.pi, np.pi, 1), (np.pi, 0.0, 1), (np.pi, 2 * np.pi, 0))
    for yaw, period, hits in ((0.2, None, 0), *cases):
        limits["heading_period_rad"] = None if period is None else np.array([period])
        assert len(match_frame(np.array([box(0, 0, yaw)]), labels, *args, **limits).truth) == hits


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
