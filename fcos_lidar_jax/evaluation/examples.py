"""Which samples to look at: the best, a typical one, the worst."""

import dataclasses

import numpy as np

from fcos_lidar_jax.evaluation.metrics import DISTANCES_M, ERROR_DISTANCE_M, Evaluation

_ROW = DISTANCES_M.index(ERROR_DISTANCE_M)


@dataclasses.dataclass(frozen=True)
class Examples:
    """Samples worth a picture."""

    rows: dict[str, int]
    """``best``, ``typical`` and ``worst`` -> row of the sample; fewer where there are fewer samples."""
    min_score: float
    """The score from which on the predictions of all samples together have the highest F1."""


def choose_examples(evaluation: Evaluation, num_samples: int) -> Examples:
    """Samples by their F1 at two metres over all classes, at the score that is best for all samples together.

    Among equals the sample with the most truth comes first. Samples without truth are left out.

    Args:
        evaluation: of the samples.
        num_samples: how many.
    """
    rankings = evaluation.rankings
    score = np.concatenate([ranking.score for ranking in rankings])
    hit = np.concatenate([ranking.hit[_ROW] for ranking in rankings])
    sample = np.concatenate([ranking.sample for ranking in rankings])
    truth = np.bincount(np.concatenate([r.truth_sample for r in rankings]), minlength=num_samples)
    order = np.argsort(-score, kind="stable")
    found = np.cumsum(hit[order])
    f1 = 2 * found / (np.arange(1, len(order) + 1) + truth.sum())
    min_score = float(score[order[np.argmax(f1)]]) if len(f1) else 0.0
    shown = score >= min_score
    hits = np.bincount(sample[shown & hit], minlength=num_samples)
    shown_count = np.bincount(sample[shown], minlength=num_samples)
    quality = 2 * hits / np.maximum(shown_count + truth, 1)
    candidates = np.flatnonzero(truth)
    if not len(candidates):
        return Examples({}, min_score)
    ranked = candidates[np.lexsort((-truth[candidates], -quality[candidates]))]
    worst = candidates[np.lexsort((-truth[candidates], quality[candidates]))[0]]
    rows = {"best": int(ranked[0]), "worst": int(worst), "typical": int(ranked[len(ranked) // 2])}
    first = {row: name for name, row in reversed(rows.items())}
    return Examples(
        {name: rows[name] for name in ("best", "typical", "worst") if first[rows[name]] == name}, min_score
    )


def sensor_boxes(
    evaluation: Evaluation, sample: int, sensor_to_global: np.ndarray, *, min_score: float
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Predictions (boxes, labels, scores) and truth (boxes, labels) of a sample in a sensor's frame, as evaluated.

    Args:
        evaluation: holds them in the global frame.
        sample: row.
        sensor_to_global: f64[4, 4].
        min_score: of the predictions.
    """
    found = evaluation.predictions
    found = found.take((found.sample == sample) & (found.score >= min_score))
    truth = evaluation.truth.take(evaluation.truth.sample == sample)
    turn, origin = sensor_to_global[:3, :3], sensor_to_global[:3, 3]

    def local(columns: np.ndarray, size: np.ndarray, yaw: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        heading = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1) @ turn
        moved = np.pad(velocity, ((0, 0), (0, 1))) @ turn
        angle = np.arctan2(heading[:, 1], heading[:, 0])[:, None]
        return np.concatenate([(columns - origin) @ turn, size[:, [1, 0, 2]], angle, moved[:, :2]], axis=1)

    return (
        (local(found.translation, found.size, found.yaw, found.velocity), found.label, found.score),
        (local(truth.translation, truth.size, truth.yaw, truth.velocity), truth.label),
    )
