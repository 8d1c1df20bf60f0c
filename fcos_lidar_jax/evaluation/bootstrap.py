"""How far the scores could be chance: samples drawn anew, with replacement."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.metrics import Evaluation, score

LEVEL = 0.95  # share of the drawn sets whose score lies in the interval


def scores_of_draw(evaluation: Evaluation, copies: np.ndarray) -> dict[str, float]:
    """``mean_ap``, and ``nd_score`` for the benchmark, of samples drawn anew, each as often as ``copies`` says.

    Samples without truth of a class say nothing about it: outside of the benchmark it then counts with its AP over
    all samples, so that the mean is of the same classes in every draw. In the benchmark a class without truth has
    an AP of 0, here as well.
    """
    rankings = [ranking.resampled(copies) for ranking in evaluation.rankings]
    summary = score(rankings, evaluation.metric)[1]
    if evaluation.metric.benchmark:
        return {name: summary[name] for name in ("mean_ap", "nd_score")}
    aps = {**evaluation.summary["mean_dist_aps"], **summary["mean_dist_aps"]}
    return {"mean_ap": float(np.mean(list(aps.values()))) if aps else float("nan")}


def bootstrap(
    evaluation: Evaluation,
    *,
    repeats: int,
    seed: int = 0,
    groups: Sequence[int] | None = None,
    report: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Intervals of the scores over sets of as many samples, drawn from those at hand.

    Matching never crosses samples, so it is done once; every set is scored by the metric of the evaluation.
    Keyframes of a scene resemble each other: unless scenes are drawn as a whole, the true intervals are wider.

    Args:
        repeats: sets to draw.
        groups: the group of each sample, counted from 0, such as its scene: groups are drawn instead of samples.
        report: called with the number of sets that are done.

    Returns:
        ``{"repeats", "seed", "level", "mean_ap": {"low", "high"}}``, and ``"nd_score"`` for the benchmark.
    """
    rng = np.random.default_rng(seed)
    members = np.arange(len(evaluation.tokens)) if groups is None else np.asarray(groups)
    number = int(members.max()) + 1
    names = [name for name in ("mean_ap", "nd_score") if name in evaluation.summary]
    drawn = np.zeros((repeats, len(names)))
    for i in range(repeats):
        copies = np.bincount(rng.integers(0, number, number), minlength=number)[members]
        drawn[i] = list(scores_of_draw(evaluation, copies).values())
        report(i + 1)
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    intervals = {name: {"low": float(low[k]), "high": float(high[k])} for k, name in enumerate(names)}
    return {"repeats": repeats, "seed": seed, "level": LEVEL, **intervals}
