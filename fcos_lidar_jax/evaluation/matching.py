"""Detections against truth by centre distance in the ground plane."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from fcos_lidar_jax.types import CLASSES

_HALF_TURN = CLASSES.index("barrier")
"""A barrier looks the same from both sides."""
_NO_HEADING = CLASSES.index("traffic_cone")
"""A cone has no heading."""


@dataclasses.dataclass(frozen=True)
class Match:
    """One-to-one hits of one frame."""

    truth: Int[np.ndarray, "p"]
    """Index of the truth of every hit."""
    detection: Int[np.ndarray, "p"]
    """Index of its detection."""
    centre_error_m: Float[np.ndarray, "p"]
    """Distance of the centres in the ground plane."""


def heading_error(predicted_rad: float, true_rad: Float[np.ndarray, "n"], label: int) -> Float[np.ndarray, "n"]:
    """Absolute yaw difference of one prediction to truths: modulo pi for barriers, zero for cones.

    Args:
        predicted_rad: yaw.
        true_rad: yaws.
        label: class index of all.

    >>> heading_error(3.2, np.array([0.0]), CLASSES.index("barrier")).round(3).tolist()
    [0.058]
    """
    if label == _NO_HEADING:
        return np.zeros(len(true_rad))
    period = np.pi if label == _HALF_TURN else 2 * np.pi
    difference = (predicted_rad - true_rad + period / 2) % period - period / 2
    return np.abs(difference)


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
    free = np.ones(len(true_boxes), bool)
    hits: list[tuple[int, int, float]] = []
    for index in np.argsort(-scores, kind="stable"):
        label = int(labels[index])
        allowed = free & (true_labels == label)
        allowed &= heading_error(float(boxes[index, 6]), true_boxes[:, 6], label) <= max_heading_error_rad
        distance = np.hypot(*(true_boxes[:, :2] - boxes[index, :2]).T)
        distance = np.where(allowed, distance, np.inf)
        if len(distance) and distance.min() < max_distance_m:
            nearest = int(distance.argmin())
            free[nearest] = False
            hits.append((nearest, int(index), float(distance[nearest])))
    truth, detection, error = zip(*hits, strict=True) if hits else ((), (), ())
    return Match(np.array(truth, int), np.array(detection, int), np.array(error, float))


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


@dataclasses.dataclass(frozen=True)
class FrameResult:
    """Detections and truth of one frame."""

    boxes: Float[np.ndarray, "d 9"]
    labels: Int[np.ndarray, "d"]
    scores: Float[np.ndarray, "d"]
    true_boxes: Float[np.ndarray, "m 9"]
    true_labels: Int[np.ndarray, "m"]


def average_precision(frames: Sequence[FrameResult], label: int, max_distance_m: float) -> float:
    """Area under the precision-recall curve of one class over frames.

    The rule of the nuScenes benchmark: precision at 101 recalls, where recall and precision below 0.1 count
    nothing. Its official filters (class ranges, racks, points) are not applied.

    Args:
        frames: detections and truth.
        label: class index.
        max_distance_m: a hit is strictly nearer.

    Returns:
        within [0, 1]; NaN without truth.

    >>> one = np.zeros((1, 9))
    >>> frame = FrameResult(one, np.array([0]), np.array([0.9]), one, np.array([0]))
    >>> round(average_precision([frame], 0, 2.0), 9)
    1.0
    """
    scores, hits, num_truth = [], [], 0
    for frame in frames:
        mine = frame.labels == label
        truth = frame.true_labels == label
        num_truth += int(truth.sum())
        match = match_frame(
            frame.boxes[mine],
            frame.labels[mine],
            frame.scores[mine],
            frame.true_boxes[truth],
            frame.true_labels[truth],
            max_distance_m=max_distance_m,
        )
        hit = np.zeros(mine.sum(), bool)
        hit[match.detection] = True
        scores.append(frame.scores[mine])
        hits.append(hit)
    if num_truth == 0:
        return float("nan")
    order = np.argsort(-np.concatenate(scores), kind="stable")
    hit = np.concatenate(hits)[order]
    if not hit.any():
        return 0.0
    found = np.cumsum(hit)
    precision, recall = found / np.arange(1, len(hit) + 1), found / num_truth
    sampled = np.interp(np.linspace(0, 1, 101), recall, precision, right=0)
    return float(np.clip(sampled[11:] - 0.1, 0, None).mean() / 0.9)
