"""Detections as plain records."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.data.cloud_policy import Cloud
from fcos_lidar_jax.types import Detections

SHOWN_SCORE = 0.3  # pictures, pages and recordings show boxes from this score

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
