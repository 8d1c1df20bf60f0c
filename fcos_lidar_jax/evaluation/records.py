"""Detections as plain records."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.data.cloud_policy import Cloud
from fcos_lidar_jax.nms import rotated_nms
from fcos_lidar_jax.types import Detections

SHOWN_SCORE = 0.3  # pictures, pages and recordings show boxes from this score

_SHOWN_OVERLAP = 0.1  # IoU on the ground from which two boxes stand for one object
_BLOCK = 128  # The number of boxes is padded to a multiple of this, so that few programs are compiled.

ScoredBoxes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Boxes [m, 9], ``x, y, z, l, w, h, yaw, vx, vy``, labels i32[m] and scores f32[m] of one cloud."""
TrueBoxes = tuple[np.ndarray, np.ndarray]
"""Boxes [m, 9] and labels i32[m] of one cloud."""


def as_records(found: Detections, classes: Sequence[str]) -> list[dict[str, Any]]:
    """Detections of one cloud, of NumPy arrays, as JSON objects, best first."""
    return [
        {"label": classes[label], "score": float(score), "box": [float(v) for v in box]}
        for box, label, score in zip(*confident(found, 0.0), strict=True)
    ]


def cloud_record(found: Detections, cloud: Cloud, classes: Sequence[str]) -> dict[str, Any]:
    """The boxes of a cloud as :func:`as_records`, after :func:`point_counts`."""
    return {**point_counts(found, cloud), "boxes": as_records(found, classes)}


def point_counts(found: Detections, cloud: Cloud) -> dict[str, Any]:
    """The numbers of a cloud's points and of those not used."""
    counts = {name: getattr(cloud, name) for name in ("num_close", "num_invalid", "num_truncated")}
    return {"num_points": cloud.num_points, "num_dropped": int(found.num_dropped) + cloud.num_removed, **counts}


def read_boxes(record: dict[str, Any], classes: Sequence[str]) -> ScoredBoxes:
    """Boxes, labels and scores of a record of :func:`cloud_record`."""
    boxes = record["boxes"]
    return (
        np.array([box["box"] for box in boxes], np.float32).reshape(-1, 9),
        np.array([classes.index(box["label"]) for box in boxes], np.int32),
        np.array([box["score"] for box in boxes], np.float32),
    )


def select(
    found: Detections,
    classes: Sequence[str],
    *,
    min_score: float | None = None,
    labels: Sequence[str] | None = None,
) -> Detections:
    """Turn detections of one cloud below a score, or of other classes than ``labels``, into padding."""
    kept = np.asarray(found.valid) & (np.asarray(found.scores) >= (min_score or 0.0))
    if labels:
        kept &= np.isin(np.asarray(found.labels), [classes.index(name) for name in labels])
    return dataclasses.replace(found, valid=kept)


def confident(found: Detections, min_score: float) -> ScoredBoxes:
    """Boxes, labels and scores of the detections of one cloud that reach a score."""
    kept = np.asarray(found.valid) & (np.asarray(found.scores) >= min_score)
    return np.asarray(found.boxes)[kept], np.asarray(found.labels)[kept], np.asarray(found.scores)[kept]


def one_per_object(found: ScoredBoxes) -> ScoredBoxes:
    """Leave out boxes that overlap a better box of any class on the ground, for pictures and pages.

    >>> boxes = np.array([[0, 0, 0, 4, 2, 2, 0, 0, 0], [0.5, 0, 0, 4, 2, 2, 0, 0, 0], [9, 0, 0, 4, 2, 2, 0, 0, 0]])
    >>> one_per_object((boxes, np.array([0, 1, 1]), np.array([0.4, 0.8, 0.5])))[1:]
    (array([1, 1]), array([0.8, 0.5]))
    """
    rows = rows_of_objects(found)
    boxes, labels, scores = (np.asarray(part)[rows] for part in found)
    return boxes, labels, scores


def rows_of_objects(found: ScoredBoxes) -> np.ndarray:
    """Rows of the boxes that :func:`one_per_object` keeps."""
    boxes, _, scores = (np.asarray(part) for part in found)
    number = len(boxes)
    padding = -(-max(number, 1) // _BLOCK) * _BLOCK - number
    padded = np.pad(boxes.reshape(-1, 9)[:, :7].astype(np.float32), ((0, padding), (0, 0)))
    index, used = _best(padded, np.pad(scores.astype(np.float32), (0, padding)), np.arange(len(padded)) < number)
    return np.sort(np.asarray(index)[np.asarray(used)])


@jax.jit
def _best(boxes: jax.Array, scores: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    return rotated_nms(boxes, scores, valid, iou_threshold=_SHOWN_OVERLAP, max_outputs=len(boxes))
