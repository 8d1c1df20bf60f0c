"""Confidence intervals over seeds and over frames."""

from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.evaluation.bootstrap import scores_of_draw
from fcos_lidar_jax.evaluation.metrics import Evaluation


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


def paired_difference(one: Evaluation, other: Evaluation, *, repeats: int = 1000) -> tuple[float, float]:
    """Compute the 95 % bootstrap interval of ``other``'s mAP minus ``one``'s, resampling the same frames for
    both."""
    rng, number, differences = np.random.default_rng(0), len(one.tokens), []
    for _ in range(repeats):
        copies = np.bincount(rng.integers(0, number, number), minlength=number)
        before, after = (scores_of_draw(evaluation, copies)["mean_ap"] for evaluation in (one, other))
        differences.append(after - before)
    low, high = np.quantile(differences, [0.025, 0.975])
    return float(low), float(high)
