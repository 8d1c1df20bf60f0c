"""How far the scores could be chance: samples drawn anew, with replacement."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.metrics import Evaluation, score

LEVEL = 0.95  # share of the drawn sets whose score lies in the interval


def bootstrap(
    evaluation: Evaluation, *, repeats: int, seed: int = 0, report: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Intervals of the scores over sets of as many samples, drawn from those at hand.

    Matching never crosses samples, so it is done once; every set is scored by the metric of the evaluation.
    Keyframes of a scene resemble each other: the true intervals are wider.

    Args:
        repeats: sets to draw.
        report: called with the number of sets that are done.

    Returns:
        ``{"repeats", "seed", "level", "mean_ap": {"low", "high"}}``, and ``"nd_score"`` for the benchmark.
    """
    rng, num_samples = np.random.default_rng(seed), len(evaluation.tokens)
    names = [name for name in ("mean_ap", "nd_score") if name in evaluation.summary]
    drawn = np.zeros((repeats, len(names)))
    for i in range(repeats):
        copies = np.bincount(rng.integers(0, num_samples, num_samples), minlength=num_samples)
        rankings = [ranking.resampled(copies) for ranking in evaluation.rankings]
        summary = score(rankings, evaluation.metric)[1]
        drawn[i] = [summary[name] for name in names]
        report(i + 1)
    known = drawn[~np.isnan(drawn).any(axis=1)]  # a set without any truth has no score
    low, high = np.quantile(known if len(known) else drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    intervals = {name: {"low": float(low[k]), "high": float(high[k])} for k, name in enumerate(names)}
    return {"repeats": repeats, "seed": seed, "level": LEVEL, **intervals}
