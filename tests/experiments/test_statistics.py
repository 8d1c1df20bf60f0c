"""Intervals over seeds, with Student's quantiles in closed form."""

import math

import pytest

from experiments.statistics import interval, seeds_needed


def quantile(degrees: int) -> float:
    """97.5 % quantile of Student's t for 1, 2 or 4 degrees of freedom."""
    p = 0.975
    if degrees == 1:
        return math.tan(math.pi * (p - 0.5))
    if degrees == 2:
        return (2 * p - 1) / math.sqrt(2 * p * (1 - p))
    root = 2 * math.sqrt(p * (1 - p))
    return 2 * math.sqrt(math.cos(math.acos(root) / 3) / root - 1)


@pytest.mark.parametrize(
    ("values", "deviation"), [([1, 3], math.sqrt(2)), ([1, 2, 3], 1), ([0, 1, 2, 3, 4], math.sqrt(2.5))]
)
def test_intervals_are_those_of_students_t(values, deviation):
    half = quantile(len(values) - 1) * deviation / math.sqrt(len(values))
    assert interval(values) == pytest.approx((2, 2 - half, 2 + half))


@pytest.mark.parametrize(("seeds", "fewer"), [(2, "3"), (3, "4"), (5, "6")])
def test_as_many_seeds_as_make_half_the_interval_smaller_than_the_gain(seeds, fewer):
    half = quantile(seeds - 1) / math.sqrt(seeds)  # of a deviation of 1
    for sign in (1, -1):
        for gain, expected in ((half * 1.001, str(seeds)), (half * 0.999, fewer)):
            middle = sign * gain
            assert seeds_needed([middle - 1, middle, middle + 1]) == expected
            assert seeds_needed([-1, 0, 1], middle) == expected


def test_what_cannot_be_told_has_no_number():
    assert seeds_needed([5.0, 5.1]) == "-"
    assert seeds_needed([-1.0, 0.0, 1.0]) == "over 100"
