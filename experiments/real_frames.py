"""Real keyframes as frame sets, and scores by class and range."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.keyframe import read_keyframe
from experiments.script import real_data
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.frame import Frame, FrameSet, InMemoryFrames, SelectedFrames
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import Evaluation, metric_of
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.types import Detections

SPANS_M = ((0, 20), (20, 40))


def real_frames(data: Path | None, reading: CloudReading) -> dict[str, FrameSet]:
    """Open the real keyframes by name: scene-0523 for choices (even) and reports (odd), and two other scenes.

    Args:
        data: folder of the real data; default: the environment's FCOS_LIDAR_REAL_DATA.
        reading: determines which points are too close.
    """
    scene = open_frames(real_data(data, "nuscenes_scene0523"), split="scene0523", reading=reading, num_sweeps=1)
    sets: dict[str, FrameSet] = {
        "scene-0523, even": SelectedFrames(scene, tuple(range(0, len(scene), 2))),
        "scene-0523, odd": SelectedFrames(scene, tuple(range(1, len(scene), 2))),
    }
    for number, frames in (("0103", 2), ("0061", 1)):
        folder = real_data(data, f"nuscenes_scene{number}")
        read = (read_keyframe(folder, SENSOR, i, reading=reading) for i in range(frames))
        sets[f"scene-{number}"] = InMemoryFrames(tuple(read), SENSOR, NUSCENES_CLASSES)
    return sets


def scores_by_range(
    detections: Iterable[Detections],
    frames: Iterable[Frame],
    *,
    repeats: int = 0,
    groups: Sequence[int] | None = None,
) -> dict[str, dict[str, Any]]:
    """Compute mAP and AP per class, of all boxes and of boxes with centres in a range of distances from the
    sensor.

    Ground truth and detections are split alike, so a match across a border counts in neither range. With
    ``repeats`` bootstrap samples of frames, or of groups of frames, the mAP of more than two frames has an
    interval.
    """
    detections, frames = list(detections), list(frames)
    parts = {"all": (detections, frames)}
    parts |= {f"{low}-{high} m": within(detections, frames, low, high) for low, high in SPANS_M}
    return {name: _scores(*part, repeats, groups) for name, part in parts.items()}


def within(
    detections: Iterable[Detections], frames: Iterable[Frame], low_m: float, high_m: float
) -> tuple[list[Detections], list[Frame]]:
    """Select detections and ground truth by the horizontal distance of their centres, excluding ``high_m``."""

    def inside(boxes: Any) -> np.ndarray:
        distance = np.hypot(*np.asarray(boxes)[:, :2].T)
        return (distance >= low_m) & (distance < high_m)

    selected = []
    for frame in frames:
        boxes = {name: getattr(frame, name)[inside(frame.boxes)] for name in ("boxes", "labels", "num_points")}
        selected.append(dataclasses.replace(frame, **boxes))
    return [dataclasses.replace(d, valid=d.valid & inside(d.boxes)) for d in detections], selected


def _scores(
    detections: list[Detections], frames: list[Frame], repeats: int, groups: Sequence[int] | None
) -> dict[str, Any]:
    evaluation = evaluate_frames(detections, frames, metric_of(NUSCENES_CLASSES))
    pairs = zip(NUSCENES_CLASSES, evaluation.rankings, strict=True)
    truths = {name: len(ranking.truth_sample) for name, ranking in pairs}
    aps = {k: round(v, 4) for k, v in evaluation.summary["mean_dist_aps"].items() if truths[k]}
    scores = {"mAP": round(evaluation.summary["mean_ap"], 4), "AP": aps, "truths": {k: truths[k] for k in aps}}
    if not (repeats and aps and len(frames) > 2):
        return scores
    return {**scores, "interval": interval_of(evaluation, "mean_ap", repeats, groups)}


def interval_of(
    evaluation: Evaluation, score: str, repeats: int, groups: Sequence[int] | None = None
) -> list[float]:
    """Compute a score's 95 % bootstrap interval over frames, or over groups of frames."""
    interval = bootstrap(evaluation, repeats=repeats, groups=groups)[score]
    return [round(interval[end], 4) for end in ("low", "high")]
