"""How far the scores could be chance: samples drawn anew, with replacement."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.metrics import ERROR_ROW, Evaluation, class_curves, summarise

LEVEL = 0.95
"""Share of the drawn sets whose score lies in the interval."""


def bootstrap(
    evaluation: Evaluation, *, repeats: int, seed: int = 0, report: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Intervals of the scores over sets of as many samples, drawn from those at hand.

    Matching never crosses samples, so it is done once; every set is scored by the metric of the evaluation.
    Keyframes of a scene resemble each other: the true intervals are wider.

    Args:
        evaluation: of the samples.
        repeats: sets to draw.
        seed: of the draws.
        report: told how many sets are done.

    Returns:
        ``{"repeats", "seed", "level", "mean_ap": {"low", "high"}}``, and ``"nd_score"`` for the benchmark.
    """
    rng, num_samples = np.random.default_rng(seed), len(evaluation.tokens)
    scores = [score for score in ("mean_ap", "nd_score") if score in evaluation.summary]
    drawn = np.zeros((repeats, len(scores)))
    for i in range(repeats):
        copies = np.bincount(rng.integers(0, num_samples, num_samples), minlength=num_samples)
        rankings = [ranking.resampled(copies, error_row=ERROR_ROW) for ranking in evaluation.rankings]
        curves = dict(zip(evaluation.curves, map(class_curves, rankings), strict=True))
        summary = summarise(curves, evaluation.metric)
        drawn[i] = [summary[score] for score in scores]
        report(i + 1)
    known = drawn[~np.isnan(drawn).any(axis=1)]  # a set without any truth has no score
    low, high = np.quantile(known if len(known) else drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    intervals = {score: {"low": float(low[k]), "high": float(high[k])} for k, score in enumerate(scores)}
    return {"repeats": repeats, "seed": seed, "level": LEVEL, **intervals}
