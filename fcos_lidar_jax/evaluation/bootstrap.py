"""How far the scores could be chance: samples drawn anew, with replacement."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.metrics import DISTANCES_M, ERROR_DISTANCE_M, draw, summarise
from fcos_lidar_jax.evaluation.ranking import Ranking
from fcos_lidar_jax.types import CLASSES

LEVEL = 0.95
"""Share of the drawn sets whose score lies in the interval."""
SCORES = ("mean_ap", "nd_score")
"""What intervals are told of."""


def bootstrap(
    rankings: Sequence[Ranking],
    num_samples: int,
    *,
    repeats: int,
    seed: int = 0,
    report: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Intervals of mAP and NDS over sets of as many samples, drawn from those at hand.

    Matching never crosses samples, so it is done once; every set is scored as the benchmark would, a class whose
    truth was not drawn with zero. Keyframes of a scene resemble each other: the true intervals are wider.

    Args:
        rankings: of an evaluation, by label.
        num_samples: that were evaluated.
        repeats: sets to draw.
        seed: of the draws.
        report: told how many sets are done.

    Returns:
        ``{"repeats", "seed", "level", "mean_ap": {"low", "high"}, "nd_score": {"low", "high"}}``.
    """
    rng = np.random.default_rng(seed)
    error_row = DISTANCES_M.index(ERROR_DISTANCE_M)
    drawn = np.zeros((repeats, len(SCORES)))
    for i in range(repeats):
        copies = np.bincount(rng.integers(0, num_samples, num_samples), minlength=num_samples)
        summary = summarise(
            {
                name: draw(ranking.resampled(copies, error_row=error_row))
                for name, ranking in zip(CLASSES, rankings, strict=True)
            }
        )
        drawn[i] = [summary[score] for score in SCORES]
        report(i + 1)
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    intervals = {score: {"low": float(low[k]), "high": float(high[k])} for k, score in enumerate(SCORES)}
    return {"repeats": repeats, "seed": seed, "level": LEVEL, **intervals}
