"""Matching and average precision: values worked out by hand."""

import numpy as np
import pytest

from fcos_lidar_jax.evaluation.matching import (
    FrameResult,
    average_precision,
    heading_error,
    match_frame,
    nearest_of_class,
)
from fcos_lidar_jax.types import CLASSES

CAR, CONE, BARRIER = (CLASSES.index(c) for c in ("car", "traffic_cone", "barrier"))


def box(x, y, yaw=0.0):
    return [x, y, 0, 4, 2, 1, yaw, 0, 0]


def test_matching_is_one_to_one_by_score_and_nearest_first():
    truth = np.array([box(0, 0), box(1, 0)])
    found = np.array([box(0.6, 0), box(0.1, 0), box(0.2, 0)])
    match = match_frame(
        found, np.zeros(3, int), np.array([0.5, 0.9, 0.8]), truth, np.zeros(2, int), max_distance_m=1.0
    )
    pairs = dict(zip(match.detection.tolist(), match.truth.tolist(), strict=True))
    assert pairs == {1: 0, 2: 1}
    np.testing.assert_allclose(match.centre_error_m, [0.1, 0.8])


def test_matching_is_strict_and_knows_classes_and_headings():
    truth, labels = np.array([box(0, 0)]), np.array([CAR])
    args = np.array([0.9]), truth, labels
    assert len(match_frame(np.array([box(0.5, 0)]), labels, *args, max_distance_m=0.5).truth) == 0
    assert len(match_frame(np.array([box(0.4, 0)]), np.array([CONE]), *args, max_distance_m=0.5).truth) == 0
    turned = np.array([box(0, 0, 0.2)])
    limits = {"max_distance_m": 0.5, "max_heading_error_rad": 0.1}
    assert len(match_frame(turned, labels, *args, **limits).truth) == 0


@pytest.mark.parametrize(
    ("label", "difference", "expected"),
    [
        (CAR, np.pi, np.pi),
        (BARRIER, np.pi, 0),
        (BARRIER, 2.0, np.pi - 2.0),
        (CONE, 1.0, 0),
        (CAR, 2 * np.pi + 0.1, 0.1),
    ],
)
def test_heading_error(label, difference, expected):
    np.testing.assert_allclose(heading_error(difference, np.zeros(2), label), [expected] * 2, atol=1e-9)


def test_nearest_of_class():
    truth = np.array([box(0, 0), box(3, 4)])
    found = nearest_of_class(np.array([box(0, 0), box(0, 0)]), np.array([1, 2]), truth, np.array([0, 1]))
    assert found.tolist() == [5.0, np.inf]


def frame(found, scores, truth):
    zeros = np.zeros
    return FrameResult(
        np.array(found).reshape(-1, 9),
        zeros(len(found), int),
        np.array(scores),
        np.array(truth).reshape(-1, 9),
        zeros(len(truth), int),
    )


def test_average_precision_by_hand():
    truth = [box(0, 0), box(20, 0)]
    assert average_precision([frame([box(0, 0), box(20, 0)], [0.9, 0.8], truth)], 0, 2.0) == pytest.approx(1)
    # One of two found: precision 1 up to recall 0.5, nothing beyond.
    assert average_precision([frame([box(0, 0)], [0.9], truth)], 0, 2.0) == pytest.approx(0.4 / 0.9)
    # A false positive ranked first: precision is recall / 2; above 0.1 it counts, at 11..100 %.
    first_false = frame([box(50, 0), box(0, 0)], [0.9, 0.8], [box(0, 0)])
    assert average_precision([first_false], 0, 2.0) == pytest.approx(
        sum(max(r / 200 - 0.1, 0) for r in range(11, 101)) / 90 / 0.9
    )
    assert average_precision([frame([], [], truth)], 0, 2.0) == 0
    assert np.isnan(average_precision([frame([box(0, 0)], [0.9], [])], 0, 2.0))


def test_average_precision_pools_frames_by_score():
    """A false box of a low score in another frame costs less than one of a high score."""
    good = frame([box(0, 0), box(20, 0)], [0.9, 0.5], [box(0, 0), box(20, 0)])
    low, high = (frame([box(0, 0)], [score], []) for score in (0.1, 0.95))
    # At recall 1 the curve ends in the false box: precision 2/3 for the last of 90 samples.
    assert average_precision([good, low], 0, 2.0) == pytest.approx((89 * 0.9 + 2 / 3 - 0.1) / 90 / 0.9)
    assert average_precision([good, high], 0, 2.0) < 0.8
