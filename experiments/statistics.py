"""Confidence intervals over seeds."""

from collections.abc import Sequence

import numpy as np

MIN_SEEDS = 3  # Fewer seeds say nothing about their deviation.
_MAX_SEEDS = 100  # Largest number of seeds that is worth naming.


def interval(values: Sequence[float]) -> tuple[float, float, float] | None:
    """Compute mean and 95 % interval of Student's t over seeds; None for fewer than two.

    >>> [round(v, 3) for v in interval([1.0, 2.0, 3.0])]
    [2.0, -0.484, 4.484]
    """
    from scipy.stats import t

    if len(values) < 2:
        return None
    mean, error = float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))
    half = float(t.ppf(0.975, len(values) - 1)) * error
    return mean, mean - half, mean + half


def gain(own: Sequence[float], other: Sequence[float]) -> tuple[float, float, float] | None:
    """Compute the difference of two means and its 95 % interval by Welch's t; None for fewer than two seeds.

    Equal seeds of two networks are not taken as pairs: they only share the order of the frames. Pairs would lose
    degrees of freedom, and the interval would depend on the numbering of the seeds.

    >>> [round(v, 3) for v in gain([2.0, 3.0, 4.0], [1.0, 2.0, 3.0])]
    [1.0, -1.267, 3.267]
    """
    from scipy.stats import ttest_ind

    if min(len(own), len(other)) < 2:
        return None
    mean = float(np.mean(own) - np.mean(other))
    if np.ptp(own) == np.ptp(other) == 0:  # without a deviation, SciPy has no interval
        return mean, mean, mean
    low, high = ttest_ind(own, other, equal_var=False).confidence_interval()
    return mean, float(low), float(high)


def seeds_needed(own: Sequence[float], other: Sequence[float], mean: float | None = None) -> str:
    """Find the smallest number of seeds with which the interval of :func:`gain` would exclude zero.

    Assumes that the deviations stay as they are.

    Args:
        own, other: scores of two configurations, one per seed.
        mean: middle of the interval; default: the present difference.

    Returns:
        the number, ``"over 100"``, or ``"-"`` if a configuration has fewer than three values.

    >>> own, other = [2.0, 3.0, 4.0], [1.0, 2.0, 3.0]
    >>> seeds_needed(own, other), seeds_needed(own, other, 0.1), seeds_needed(own, [1.0, 2.0])
    ('9', 'over 100', '-')
    """
    from scipy.stats import ttest_ind_from_stats

    if min(len(own), len(other)) < MIN_SEEDS:
        return "-"
    middle = float(np.mean(own) - np.mean(other)) if mean is None else mean
    deviations = [float(np.std(values, ddof=1)) for values in (own, other)]

    def excludes_zero(number: int) -> bool:
        arms = middle, deviations[0], number, 0.0, deviations[1], number
        return bool(ttest_ind_from_stats(*arms, equal_var=False).pvalue < 0.05)

    return str(next(filter(excludes_zero, range(2, _MAX_SEEDS + 1)), f"over {_MAX_SEEDS}"))
