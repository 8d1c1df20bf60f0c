"""Predictions of all samples in the order of their scores, each a hit or a miss."""

import dataclasses

import numpy as np

from fcos_lidar_jax.evaluation.boxes import BoxColumns
from fcos_lidar_jax.evaluation.matching import candidate_pairs, greedy, heading_error
from fcos_lidar_jax.types import CLASSES

TP_ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
"""The official names of the errors of a hit: metres, 1 - IoU of the aligned boxes, radians, m/s, 0 or 1."""


@dataclasses.dataclass(frozen=True)
class Ranking:
    """The predictions of one class over all samples, best first, and the truth that they were to find."""

    score: np.ndarray
    """f64[p], falling."""
    sample: np.ndarray
    """i32[p]: row of the sample."""
    hit: np.ndarray
    """bool[t, p]: for every matching distance."""
    errors: np.ndarray
    """f64[5, h]: :data:`TP_ERRORS` of the hits at the distance for errors, NaN where the truth does not tell."""
    truth_sample: np.ndarray
    """i32[g]: row of the sample of every truth."""

    def resampled(self, copies: np.ndarray, *, error_row: int) -> "Ranking":
        """As if every sample had been there so many times.

        Args:
            copies: i64[samples].
            error_row: which row of ``hit`` the errors are of.
        """
        times = copies[self.sample]
        return Ranking(
            score=np.repeat(self.score, times),
            sample=np.repeat(self.sample, times),
            hit=np.repeat(self.hit, times, axis=1),
            errors=np.repeat(self.errors, times[self.hit[error_row]], axis=1),
            truth_sample=np.repeat(self.truth_sample, copies[self.truth_sample]),
        )


def rank(
    predictions: BoxColumns, truth: BoxColumns, *, distances_m: tuple[float, ...], error_row: int
) -> tuple[Ranking, ...]:
    """Match predictions to truth, and sort them by score; one ranking a class.

    By falling score, each prediction takes the nearest free truth of its class in its sample; of equal scores the
    later prediction comes first, of equal distances the first truth is taken. A hit is strictly nearer than the
    matching distance, centre to centre in the ground plane.

    Args:
        predictions: filtered, in the order of the results.
        truth: filtered.
        distances_m: matching distances.
        error_row: which of them the errors are of.
    """
    predictions = predictions.take(np.argsort(predictions.score, kind="stable")[::-1])
    pairs = candidate_pairs(
        _group(predictions),
        predictions.translation[:, :2],
        _group(truth),
        truth.translation[:, :2],
        max_distance_m=max(distances_m),
    )
    partner = np.stack([greedy(pairs.nearer(limit), len(predictions), len(truth)) for limit in distances_m])
    hit = partner >= 0
    found = hit[error_row]
    errors = hit_errors(predictions.take(found), truth.take(partner[error_row, found]))
    rankings = []
    for label in range(len(CLASSES)):
        own = predictions.label == label
        rankings.append(
            Ranking(
                score=predictions.score[own],
                sample=predictions.sample[own],
                hit=hit[:, own],
                errors=errors[:, own[found]],
                truth_sample=truth.sample[truth.label == label],
            )
        )
    return tuple(rankings)


def _group(boxes: BoxColumns) -> np.ndarray:
    """One number for every class in every sample: only boxes of the same can match."""
    return boxes.sample.astype(np.int64) * len(CLASSES) + boxes.label


def hit_errors(predictions: BoxColumns, truth: BoxColumns) -> np.ndarray:
    """Errors of predictions to their truths, row by row, f64[5, n] in the order of :data:`TP_ERRORS`."""
    offset = predictions.translation[:, :2] - truth.translation[:, :2]
    shared = np.minimum(predictions.size, truth.size).prod(axis=1)
    union = truth.size.prod(axis=1) + predictions.size.prod(axis=1) - shared
    turn = heading_error(predictions.yaw, truth.yaw, truth.label)
    wrong = (truth.attribute != predictions.attribute).astype(float)
    speed = predictions.velocity - truth.velocity
    return np.stack(
        [
            np.sqrt((offset**2).sum(axis=1)),
            1 - shared / union,
            turn,
            np.sqrt((speed**2).sum(axis=1)),
            np.where(truth.attribute < 0, np.nan, wrong),
        ]
    )
