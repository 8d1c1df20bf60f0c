"""Confidence intervals over seeds."""

import math
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


def seeds_needed(values: Sequence[float], gain: float | None = None) -> str:
    """Find the smallest number of seeds with which :func:`interval` would exclude zero.

    Assumes that the deviation stays as it is.

    Args:
        values: differences between two configurations, one per seed.
        gain: middle of the interval; default: the mean of the values.

    Returns:
        the number, ``"over 100"``, or ``"-"`` for fewer than three values.

    >>> seeds_needed([1.0, 2.0, 3.0]), seeds_needed([1.0, 2.0, 3.0], 0.1), seeds_needed([1.0, 2.0])
    ('4', 'over 100', '-')
    """
    from scipy.stats import t

    if len(values) < MIN_SEEDS:
        return "-"
    middle = abs(float(np.mean(values)) if gain is None else gain)
    deviation, numbers = float(np.std(values, ddof=1)), range(2, _MAX_SEEDS + 1)
    enough = (n for n in numbers if float(t.ppf(0.975, n - 1)) * deviation / math.sqrt(n) < middle)
    return str(next(enough, f"over {_MAX_SEEDS}"))
