"""Detections against truth by centre distance in the ground plane: in one frame, and ranked over many."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from fcos_lidar_jax.evaluation.boxes import BoxColumns

TP_ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
"""The official names of the errors of a hit: metres, 1 - IoU of the aligned boxes, radians, m/s, 0 or 1."""
_BLOCK = 1 << 21
"""Pairs whose distance is computed at once: bounds the memory."""


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Detections and truths that could match: by detection, then by distance, then by truth."""

    detection: Int[np.ndarray, "p"]
    """Index of the detection."""
    truth: Int[np.ndarray, "p"]
    """Index of the truth."""
    distance_m: Float[np.ndarray, "p"]
    """Distance of the centres in the ground plane."""

    def nearer(self, limit_m: float) -> "Pairs":
        """The pairs strictly nearer than a limit."""
        near = self.distance_m < limit_m
        return Pairs(self.detection[near], self.truth[near], self.distance_m[near])


def candidate_pairs(
    group: Int[np.ndarray, "d"],
    centres: Float[np.ndarray, "d 2"],
    true_group: Int[np.ndarray, "m"],
    true_centres: Float[np.ndarray, "m 2"],
    *,
    max_distance_m: float,
) -> Pairs:
    """All pairs of one group that are strictly nearer than a distance.

    Args:
        group: of every detection, such as a number for every class in every sample.
        centres: of the detections, metres.
        true_group: of every truth.
        true_centres: of the truths.
        max_distance_m: limit.

    >>> one = np.zeros(1, int)
    >>> pairs = candidate_pairs(one, np.zeros((1, 2)), one, np.ones((1, 2)), max_distance_m=2)
    >>> pairs.distance_m.round(3).tolist()
    [1.414]
    """
    by_group = np.argsort(true_group, kind="stable")
    grouped = true_group[by_group]
    first = np.searchsorted(grouped, group)
    count = np.searchsorted(grouped, group, "right") - first
    ends = np.cumsum(count)
    x, y, true_x, true_y = (np.ascontiguousarray(column) for c in (centres, true_centres) for column in c.T)
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    start = 0
    while start < len(group):
        before = int(ends[start - 1]) if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + _BLOCK, "right")))
        detection = np.repeat(np.arange(start, stop), count[start:stop])
        nth = np.arange(len(detection)) - np.repeat(
            ends[start:stop] - count[start:stop] - before, count[start:stop]
        )
        truth = by_group[first[detection] + nth]
        dx, dy = x[detection] - true_x[truth], y[detection] - true_y[truth]
        distance = np.sqrt(dx * dx + dy * dy)
        near = distance < max_distance_m
        parts.append((detection[near], truth[near], distance[near]))
        start = stop
    detection, truth, distance = (np.concatenate(column) for column in zip(*parts, strict=True))
    # Stable: of equal distances the first truth stays first.
    order = np.lexsort((distance, detection))
    return Pairs(detection[order], truth[order], distance[order])


def greedy(pairs: Pairs, num_detections: int, num_truths: int) -> Int[np.ndarray, "d"]:
    """The truth of every detection, -1 for none: in their order, each takes the nearest truth that is free.

    Args:
        pairs: that may match; detections in the order in which they choose.
        num_detections: of all.
        num_truths: of all.

    >>> greedy(Pairs(np.array([0, 1, 1]), np.array([1, 1, 0]), np.array([0.2, 0.1, 0.3])), 2, 2).tolist()
    [1, 0]
    """
    partner, taken = [-1] * num_detections, bytearray(num_truths)
    for detection, truth in zip(pairs.detection.tolist(), pairs.truth.tolist(), strict=True):
        if partner[detection] < 0 and not taken[truth]:
            partner[detection] = truth
            taken[truth] = 1
    return np.array(partner, np.int64)


@dataclasses.dataclass(frozen=True)
class Match:
    """One-to-one hits of one frame."""

    truth: Int[np.ndarray, "p"]
    """Index of the truth of every hit, the best detection's first."""
    detection: Int[np.ndarray, "p"]
    """Index of its detection."""
    centre_error_m: Float[np.ndarray, "p"]
    """Distance of the centres in the ground plane."""


def heading_error(
    predicted_rad: Float[np.ndarray, "n"], true_rad: Float[np.ndarray, "n"], period_rad: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Absolute yaw difference of predictions to truths, row by row.

    Args:
        predicted_rad: yaws.
        true_rad: yaws.
        period_rad: the turn after which a box looks the same: 2 pi, pi for half-turn symmetric classes, 0 for
            classes without a heading, whose error is 0.

    >>> heading_error(np.array([3.2]), np.zeros(1), np.array([np.pi])).round(3).tolist()
    [0.058]
    """
    turn = np.where(period_rad > 0, period_rad, 1.0)
    difference = np.abs((true_rad - predicted_rad + turn / 2) % turn - turn / 2)
    return np.where(period_rad > 0, difference, 0.0)


def match_frame(
    boxes: Float[np.ndarray, "d 9"],
    labels: Int[np.ndarray, "d"],
    scores: Float[np.ndarray, "d"],
    true_boxes: Float[np.ndarray, "m 9"],
    true_labels: Int[np.ndarray, "m"],
    *,
    max_distance_m: float,
    max_heading_error_rad: float = np.inf,
    heading_period_rad: Float[np.ndarray, "k"] | None = None,
) -> Match:
    """Greedy one-to-one matching: by falling score, each detection takes the nearest free truth of its class.

    Args:
        boxes: detections, ``x, y, z, l, w, h, yaw, vx, vy``.
        labels: their classes.
        scores: their scores; equal ones in the order given.
        true_boxes: truths.
        true_labels: their classes.
        max_distance_m: hits are strictly nearer, in the ground plane.
        max_heading_error_rad: hits are at most this far off in yaw.
        heading_period_rad: of every class, see :func:`heading_error`; default: 2 pi for all.

    >>> one = np.array([[0, 0, 0, 1, 1, 1, 0, 0, 0.0]])
    >>> car = np.array([0])
    >>> match_frame(one, car, np.array([0.9]), one, car, max_distance_m=0.5).truth.tolist()
    [0]
    """
    order = np.argsort(-scores, kind="stable")
    boxes, labels = boxes[order].astype(np.float64), labels[order]
    true_boxes = true_boxes.astype(np.float64)
    pairs = candidate_pairs(labels, boxes[:, :2], true_labels, true_boxes[:, :2], max_distance_m=max_distance_m)
    own_labels = labels[pairs.detection]
    period = np.full(len(own_labels), 2 * np.pi) if heading_period_rad is None else heading_period_rad[own_labels]
    turn = heading_error(boxes[pairs.detection, 6], true_boxes[pairs.truth, 6], period)
    kept = turn <= max_heading_error_rad
    partner = greedy(
        Pairs(pairs.detection[kept], pairs.truth[kept], pairs.distance_m[kept]), len(boxes), len(true_boxes)
    )
    found = np.flatnonzero(partner >= 0)
    truth = partner[found]
    offset = boxes[found, :2] - true_boxes[truth, :2]
    return Match(truth, order[found], np.sqrt((offset**2).sum(axis=1)))


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
    knows_velocity: bool
    """Whether some truth has a velocity."""

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
            knows_velocity=self.knows_velocity,
        )


def rank(
    predictions: BoxColumns,
    truth: BoxColumns,
    *,
    heading_period_rad: Float[np.ndarray, "k"],
    distances_m: tuple[float, ...],
    error_row: int,
) -> tuple[Ranking, ...]:
    """Match predictions to truth, and sort them by score; one ranking a class.

    By falling score, each prediction takes the nearest free truth of its class in its sample; of equal scores the
    later prediction comes first, of equal distances the first truth is taken. A hit is strictly nearer than the
    matching distance, centre to centre in the ground plane.

    Args:
        predictions: filtered, in the order of the results.
        truth: filtered.
        heading_period_rad: of every class, see :func:`heading_error`; there are as many classes.
        distances_m: matching distances.
        error_row: which of them the errors are of.
    """
    num_classes = len(heading_period_rad)
    predictions = predictions.take(np.argsort(predictions.score, kind="stable")[::-1])
    pairs = candidate_pairs(
        _group(predictions, num_classes),
        predictions.translation[:, :2],
        _group(truth, num_classes),
        truth.translation[:, :2],
        max_distance_m=max(distances_m),
    )
    partner = np.stack([greedy(pairs.nearer(limit), len(predictions), len(truth)) for limit in distances_m])
    hit = partner >= 0
    found = hit[error_row]
    errors = hit_errors(predictions.take(found), truth.take(partner[error_row, found]), heading_period_rad)
    rankings = []
    for label in range(num_classes):
        own, true = predictions.label == label, truth.label == label
        rankings.append(
            Ranking(
                score=predictions.score[own],
                sample=predictions.sample[own],
                hit=hit[:, own],
                errors=errors[:, own[found]],
                truth_sample=truth.sample[true],
                knows_velocity=bool(np.isfinite(truth.velocity[true]).all(axis=1).any()),
            )
        )
    return tuple(rankings)


def _group(boxes: BoxColumns, num_classes: int) -> np.ndarray:
    """One number for every class in every sample: only boxes of the same can match."""
    return boxes.sample.astype(np.int64) * num_classes + boxes.label


def hit_errors(predictions: BoxColumns, truth: BoxColumns, heading_period_rad: np.ndarray) -> np.ndarray:
    """Errors of predictions to their truths, row by row, f64[5, n] in the order of :data:`TP_ERRORS`."""
    offset = predictions.translation[:, :2] - truth.translation[:, :2]
    shared = np.minimum(predictions.size, truth.size).prod(axis=1)
    union = truth.size.prod(axis=1) + predictions.size.prod(axis=1) - shared
    turn = heading_error(predictions.yaw, truth.yaw, heading_period_rad[truth.label])
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
