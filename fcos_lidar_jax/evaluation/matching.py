"""Detections against truth by centre distance in the ground plane."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from fcos_lidar_jax.types import CLASSES

_HALF_TURN = CLASSES.index("barrier")
"""A barrier looks the same from both sides."""
_NO_HEADING = CLASSES.index("traffic_cone")
"""A cone has no heading."""
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
    predicted_rad: Float[np.ndarray, "n"], true_rad: Float[np.ndarray, "n"], label: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Absolute yaw difference of predictions to truths, row by row: modulo pi for barriers, zero for cones.

    Args:
        predicted_rad: yaws.
        true_rad: yaws.
        label: class indices.

    >>> heading_error(np.array([3.2]), np.array([0.0]), np.array([CLASSES.index("barrier")])).round(3).tolist()
    [0.058]
    """
    period = np.where(label == _HALF_TURN, np.pi, 2 * np.pi)
    difference = np.abs((true_rad - predicted_rad + period / 2) % period - period / 2)
    return np.where(label == _NO_HEADING, 0.0, difference)


def match_frame(
    boxes: Float[np.ndarray, "d 9"],
    labels: Int[np.ndarray, "d"],
    scores: Float[np.ndarray, "d"],
    true_boxes: Float[np.ndarray, "m 9"],
    true_labels: Int[np.ndarray, "m"],
    *,
    max_distance_m: float,
    max_heading_error_rad: float = np.inf,
) -> Match:
    """Greedy one-to-one matching: by falling score, each detection takes the nearest free truth of its class.

    Args:
        boxes: detections, ``x, y, z, l, w, h, yaw, vx, vy``.
        labels: their classes.
        scores: their scores; equal ones in the order given.
        true_boxes: truths.
        true_labels: their classes.
        max_distance_m: hits are strictly nearer, in the ground plane.
        max_heading_error_rad: hits are at most this far off in yaw, see :func:`heading_error`.

    >>> one = np.array([[0, 0, 0, 1, 1, 1, 0, 0, 0.0]])
    >>> car = np.array([0])
    >>> match_frame(one, car, np.array([0.9]), one, car, max_distance_m=0.5).truth.tolist()
    [0]
    """
    order = np.argsort(-scores, kind="stable")
    boxes, labels = boxes[order].astype(np.float64), labels[order]
    true_boxes = true_boxes.astype(np.float64)
    pairs = candidate_pairs(labels, boxes[:, :2], true_labels, true_boxes[:, :2], max_distance_m=max_distance_m)
    turn = heading_error(boxes[pairs.detection, 6], true_boxes[pairs.truth, 6], labels[pairs.detection])
    kept = turn <= max_heading_error_rad
    partner = greedy(
        Pairs(pairs.detection[kept], pairs.truth[kept], pairs.distance_m[kept]), len(boxes), len(true_boxes)
    )
    found = np.flatnonzero(partner >= 0)
    truth = partner[found]
    offset = boxes[found, :2] - true_boxes[truth, :2]
    return Match(truth, order[found], np.sqrt((offset**2).sum(axis=1)))


def nearest_of_class(
    boxes: Float[np.ndarray, "d 9"],
    labels: Int[np.ndarray, "d"],
    true_boxes: Float[np.ndarray, "m 9"],
    true_labels: Int[np.ndarray, "m"],
) -> Float[np.ndarray, "d"]:
    """Distance of every detection to the nearest truth of its class, in metres; inf where there is none.

    >>> box = np.zeros((1, 9))
    >>> nearest_of_class(box, np.array([0]), box, np.array([1])).tolist()
    [inf]
    """
    distance = np.hypot(boxes[:, None, 0] - true_boxes[None, :, 0], boxes[:, None, 1] - true_boxes[None, :, 1])
    distance = np.where(labels[:, None] == true_labels, distance, np.inf)
    return distance.min(axis=1, initial=np.inf)
