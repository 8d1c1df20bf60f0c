"""Bootstrap intervals of the scores, from samples drawn with replacement."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.metrics import Evaluation, score

LEVEL = 0.95  # share of the resampled sets whose score lies in the interval


def scores_of_draw(evaluation: Evaluation, copies: np.ndarray) -> dict[str, float]:
    """``mean_ap``, and ``nd_score`` for the benchmark, of a resampled set with ``copies`` of each sample.

    If a resampled set has no truth of a class, the class counts with its AP over all samples, so that the mean is
    always over the same classes. In the benchmark such a class has an AP of 0.
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
    """Intervals of the scores over ``repeats`` resampled sets with the same number of samples.

    Matching never crosses samples and is done once. Each set is scored by the metric of the evaluation. Keyframes
    of a scene resemble each other, so the true intervals are wider unless whole scenes are drawn: ``groups`` are
    the group of each sample, starting at 0. ``report`` is called with the number of finished sets.

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
