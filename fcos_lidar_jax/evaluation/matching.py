"""Match detections to truth by centre distance in the ground plane, in one frame or ranked over many samples."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from fcos_lidar_jax.evaluation.boxes import BoxColumns, Columns

TP_ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
"""Official names of the errors of a hit: metres, 1 - IoU of aligned boxes, radians, m/s, 0 or 1."""
DISTANCES_M = (0.5, 1.0, 2.0, 4.0)  # matching distances; the AP of a class is the mean over all four
ERROR_ROW = 2  # errors are measured for the hits within the third distance, two metres
_BLOCK = 1 << 21  # maximum number of distances computed at once, to bound memory


@dataclasses.dataclass(frozen=True)
class Pairs(Columns):
    """Detections and truths that could match, sorted by detection, distance and truth."""

    detection: Int[np.ndarray, "p"]  # index of the detection
    truth: Int[np.ndarray, "p"]  # index of the truth
    distance_m: Float[np.ndarray, "p"]  # distance of the centres in the ground plane


def candidate_pairs(
    group: Int[np.ndarray, "d"],
    centres: Float[np.ndarray, "d 2"],
    true_group: Int[np.ndarray, "m"],
    true_centres: Float[np.ndarray, "m 2"],
    *,
    max_distance_m: float,
) -> Pairs:
    """Find all pairs within a group, such as a class in a sample, whose centres are nearer than a distance."""
    by_group = np.argsort(true_group, kind="stable")
    grouped = true_group[by_group]
    first = np.searchsorted(grouped, group)
    count = np.searchsorted(grouped, group, "right") - first
    x, y, true_x, true_y = (np.ascontiguousarray(column) for c in (centres, true_centres) for column in c.T)
    block = (np.cumsum(count) - count) // _BLOCK
    parts = []
    for rows in np.split(np.arange(len(group)), np.flatnonzero(np.diff(block)) + 1):
        own = count[rows]
        detection = np.repeat(rows, own)
        nth = np.arange(len(detection)) - np.repeat(np.cumsum(own) - own, own)
        truth = by_group[first[detection] + nth]
        dx, dy = x[detection] - true_x[truth], y[detection] - true_y[truth]
        distance = np.sqrt(dx * dx + dy * dy)
        near = distance < max_distance_m
        parts.append((detection[near], truth[near], distance[near]))
    detection, truth, distance = (np.concatenate(column) for column in zip(*parts, strict=True))
    # The sort is stable: the first truth stays first among equal distances.
    return Pairs(detection, truth, distance).take(np.lexsort((distance, detection)))


def greedy(pairs: Pairs, num_detections: int, num_truths: int) -> Int[np.ndarray, "d"]:
    """Match each detection, in order of priority, to its nearest free truth; -1 for detections without a match."""
    partner, taken = [-1] * num_detections, bytearray(num_truths)
    for detection, truth in zip(pairs.detection.tolist(), pairs.truth.tolist(), strict=True):
        if partner[detection] < 0 and not taken[truth]:
            partner[detection], taken[truth] = truth, 1
    return np.array(partner, np.int64)


def heading_error(
    predicted_rad: Float[np.ndarray, "n"], true_rad: Float[np.ndarray, "n"], period_rad: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Absolute yaw difference between predictions and truths, row by row.

    The period is the rotation that maps a box onto itself: 2 pi in general, pi for classes with half-turn
    symmetry, and 0 for classes without a heading, whose error is 0.
    """
    turn = np.where(period_rad > 0, period_rad, 1.0)
    difference = np.abs((true_rad - predicted_rad + turn / 2) % turn - turn / 2)
    return np.where(period_rad > 0, difference, 0.0)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt((vectors**2).sum(axis=1))


@dataclasses.dataclass(frozen=True)
class Ranking:
    """Predictions and truth of one class over all samples, predictions by decreasing score."""

    score: np.ndarray  # f64[p], decreasing
    sample: np.ndarray  # i32[p]: row of the sample
    hit: np.ndarray  # bool[t, p]: hits per matching distance
    errors: np.ndarray  # f64[5, h]: TP_ERRORS of the hits of row ERROR_ROW, NaN where the truth is unknown
    truth_sample: np.ndarray  # i32[g]: row of the sample of each truth
    knows_velocity: bool  # whether any truth has a velocity

    def resampled(self, copies: np.ndarray) -> "Ranking":
        """Ranking of a set with i64[samples] ``copies`` of each sample."""
        times = copies[self.sample]
        return dataclasses.replace(
            self,
            score=np.repeat(self.score, times),
            sample=np.repeat(self.sample, times),
            hit=np.repeat(self.hit, times, axis=1),
            errors=np.repeat(self.errors, times[self.hit[ERROR_ROW]], axis=1),
            truth_sample=np.repeat(self.truth_sample, copies[self.truth_sample]),
        )


def rank(
    predictions: BoxColumns,
    truth: BoxColumns,
    *,
    heading_period_rad: Float[np.ndarray, "k"],
    distances_m: tuple[float, ...] = DISTANCES_M,
) -> tuple[Ranking, ...]:
    """Match predictions to truth and sort them by score; returns one ranking per class.

    By decreasing score, each prediction is matched to the nearest free truth of its class in its sample. The later
    prediction wins among equal scores, the first truth among equal distances. A hit is strictly nearer than the
    matching distance, from centre to centre in the ground plane.

    Args:
        heading_period_rad: period per class, see :func:`heading_error`; determines the number of classes.
        distances_m: matching distances; errors are measured within the distance of row :data:`ERROR_ROW`.
    """
    num_classes = len(heading_period_rad)
    predictions = predictions.take(np.argsort(predictions.score, kind="stable")[::-1])
    # Only boxes of the same class and sample, and thus the same group, can match.
    group, true_group = (b.sample.astype(np.int64) * num_classes + b.label for b in (predictions, truth))
    centres, true_centres = predictions.translation[:, :2], truth.translation[:, :2]
    pairs = candidate_pairs(group, centres, true_group, true_centres, max_distance_m=max(distances_m))
    nearer = (pairs.take(pairs.distance_m < limit) for limit in distances_m)
    partner = np.stack([greedy(near, len(predictions), len(truth)) for near in nearer])
    hit = partner >= 0
    error_hit = hit[ERROR_ROW]
    hit_truth = truth.take(partner[ERROR_ROW, error_hit])
    errors = _hit_errors(predictions.take(error_hit), hit_truth, heading_period_rad)

    def of_class(label: int) -> Ranking:
        own, true = predictions.label == label, truth.label == label
        return Ranking(
            score=predictions.score[own],
            sample=predictions.sample[own],
            hit=hit[:, own],
            errors=errors[:, own[error_hit]],
            truth_sample=truth.sample[true],
            knows_velocity=bool(np.isfinite(truth.velocity[true]).all(axis=1).any()),
        )

    return tuple(map(of_class, range(num_classes)))


def _hit_errors(predictions: BoxColumns, truth: BoxColumns, heading_period_rad: np.ndarray) -> np.ndarray:
    """Errors of predictions relative to their truths, f64[5, n], rows in the order of :data:`TP_ERRORS`."""
    shared = np.minimum(predictions.size, truth.size).prod(axis=1)
    union = truth.size.prod(axis=1) + predictions.size.prod(axis=1) - shared
    centre = _length(predictions.translation[:, :2] - truth.translation[:, :2])
    heading = heading_error(predictions.yaw, truth.yaw, heading_period_rad[truth.label])
    velocity = _length(predictions.velocity - truth.velocity)
    attribute = np.where(truth.attribute < 0, np.nan, truth.attribute != predictions.attribute)
    return np.stack([centre, 1 - shared / union, heading, velocity, attribute])
