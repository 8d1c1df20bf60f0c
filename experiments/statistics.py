"""Confidence intervals over seeds and over frames."""

import math
from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.evaluation.bootstrap import scores_of_draw
from fcos_lidar_jax.evaluation.metrics import Evaluation

MIN_SEEDS = 3  # Fewer seeds say nothing about their deviation.
_MAX_SEEDS = 100  # Largest number of seeds that is worth naming.
_REPEATS = 1000  # Bootstrap samples of an interval.


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


def bootstrap_weights(number: int) -> np.ndarray:
    """Weights of frames, i64[k, number]: first ones, then those of bootstrap samples if there are several frames.

    >>> bootstrap_weights(1).tolist()
    [[1]]
    >>> bootstrap_weights(3).shape, set(bootstrap_weights(3).sum(axis=1).tolist())
    ((1001, 3), {3})
    """
    resampled = np.random.default_rng(0).multinomial(number, np.full(number, 1 / number), _REPEATS)
    return np.concatenate([np.ones((1, number), int), resampled if number > 1 else resampled[:0]])


def percent(part: np.ndarray, whole: np.ndarray) -> list[float]:
    """Share of the first element, with its 95 % interval if bootstrap samples follow.

    >>> percent(np.array([1]), np.array([4])), percent(np.array([1, 0, 2]), np.array([4, 4, 4]))
    ([25.0], [25.0, 1.2, 48.8])
    """
    share, *resampled = 100 * part / np.maximum(whole, 1)
    bounds = np.quantile(resampled, [0.025, 0.975]) if resampled else ()
    return [round(float(value), 1) for value in (share, *bounds)]


def paired_difference(one: Evaluation, other: Evaluation, *, repeats: int = _REPEATS) -> tuple[float, float]:
    """Compute the 95 % bootstrap interval of ``other``'s mAP minus ``one``'s, resampling the same frames for
    both."""
    rng, number, differences = np.random.default_rng(0), len(one.tokens), []
    for _ in range(repeats):
        copies = np.bincount(rng.integers(0, number, number), minlength=number)
        before, after = (scores_of_draw(evaluation, copies)["mean_ap"] for evaluation in (one, other))
        differences.append(after - before)
    low, high = np.quantile(differences, [0.025, 0.975])
    return float(low), float(high)
