"""Real keyframes, alone and as frame sets, and scores by class and range."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.script import real_data
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import WHOLE_SWEEP, CloudReading
from fcos_lidar_jax.data.box_geometry import LIMITS, check_boxes
from fcos_lidar_jax.data.frame import Frame, FrameSet, InMemoryFrames, SelectedFrames, drop_close
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import Evaluation, metric_of
from fcos_lidar_jax.files import read_json, refusing
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Detections

SPANS_M = ((0, 20), (20, 40))


def read_keyframe(folder: Path, sensor: Sensor, number: int = 0, reading: CloudReading = WHOLE_SWEEP) -> Frame:
    """Read a folder's keyframe, or a list's keyframe by its number, with the boxes of the ten nuScenes classes.

    ``boxes.json`` is ``{"lidar_file": NAME, "boxes": [{"class", "x", "y", "z", "l", "w", "h", "yaw", "vx", "vy",
    "num_lidar_pts"}]}`` in the LiDAR frame, or a list of such records. The count may also be called
    "num_lidar_pts_at_key_frame". Unknown velocities are null and become NaN. Other classes are dropped.

    Raises:
        ValueError: with the file and the field.
    """
    file = folder / "boxes.json"
    record = read_json(file, what="the boxes of a keyframe")
    with refusing(f"{file}: a field is missing or of another kind"):
        record = record[number] if isinstance(record, list) else record
        rows = [b for b in record["boxes"] if b["class"] in NUSCENES_CLASSES]
        boxes = np.array([[np.nan if b[k] is None else float(b[k]) for k in LIMITS] for b in rows])
        count = "num_lidar_pts" if all("num_lidar_pts" in b for b in rows) else "num_lidar_pts_at_key_frame"
        counts = np.array([int(b[count]) for b in rows], np.int32)
        cloud = folder / str(record["lidar_file"])
    boxes = boxes.reshape(-1, 9)
    check_boxes(boxes, lambda i: f"{file}: box {i} of the ten classes")
    labels = np.array([NUSCENES_CLASSES.index(b["class"]) for b in rows], np.int32)
    points, num_close = drop_close(read_points(cloud, sensor), sensor, reading)
    return Frame(points, boxes.astype(np.float32), labels, counts, num_close)


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
    detections: Sequence[Detections],
    frames: Sequence[Frame],
    *,
    repeats: int = 0,
    groups: Sequence[int] | None = None,
) -> dict[str, dict[str, Any]]:
    """Compute mAP and AP per class, of all boxes and of those whose centres are in a range of distances.

    Ground truth and detections are split alike, so a match across a border counts in neither range. With
    ``repeats`` bootstrap samples of frames, or of groups of frames, the mAP of more than two frames has an
    interval.
    """
    parts = {"all": (detections, frames)}
    parts |= {f"{low}-{high} m": within(detections, frames, low, high) for low, high in SPANS_M}
    return {name: _scores(*part, repeats, groups) for name, part in parts.items()}


def within(
    detections: Sequence[Detections], frames: Sequence[Frame], low_m: float, high_m: float
) -> tuple[Sequence[Detections], Sequence[Frame]]:
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
    detections: Sequence[Detections], frames: Sequence[Frame], repeats: int, groups: Sequence[int] | None
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
