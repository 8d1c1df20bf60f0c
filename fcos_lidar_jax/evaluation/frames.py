"""Evaluation of frames of any data set: boxes in the sensor's frame, without tokens, racks and attributes."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.sweeps import FARTHEST_M
from fcos_lidar_jax.evaluation.boxes import NO_BOXES, BoxColumns, GroundTruth, join, make_columns
from fcos_lidar_jax.evaluation.json_io import expect, expect_samples, index_of, read_source, write_lines
from fcos_lidar_jax.evaluation.metrics import Evaluation, Metric, evaluate
from fcos_lidar_jax.evaluation.records import confident
from fcos_lidar_jax.types import Detections


def evaluate_frames(found: Iterable[Detections], frames: Iterable[Frame], metric: Metric) -> Evaluation:
    """Evaluate detections against the boxes of their frames with the mAP by centre distance.

    This is not the nuScenes benchmark: ranges are measured from the origin of the points instead of the ego
    vehicle, only LiDAR points decide whether a box is evaluated, there are no bicycle racks, attributes or NDS,
    and means are over the classes that occur in the truth.

    Args:
        found: NumPy detections per frame, with labels by the metric's classes.
        frames: frames with ground truth, with labels by the metric's classes; boxes without points are not
            evaluated. The points of the frames are not used.
        metric: from :func:`fcos_lidar_jax.evaluation.metrics.metric_of`.

    Raises:
        ValueError: the metric is the benchmark's.

    >>> from fcos_lidar_jax.evaluation.metrics import metric_of
    >>> frame = Frame(np.zeros((0, 5)), np.ones((1, 9)), np.zeros(1, int), np.ones(1, int))
    >>> exact = Detections(frame.boxes, np.ones(1), frame.labels, np.ones(1, bool), np.zeros(0))
    >>> round(evaluate_frames([exact], [frame], metric_of(["car", "tram"])).summary["mean_ap"], 9)
    1.0
    """
    if metric.benchmark:
        raise ValueError("metric: got the nuScenes benchmark's, expected metric_of(...): frames lack attributes")
    return evaluate(*frame_columns(found, frames), metric)


def frame_columns(
    found: Iterable[Detections], frames: Iterable[Frame], names: Sequence[str] = ()
) -> tuple[BoxColumns, GroundTruth]:
    """Convert detections and truth of frames to columns, with the sensor's frame as the global frame.

    ``names`` are the names of the samples; by default samples are numbered.
    """
    predictions, truths = [NO_BOXES], [NO_BOXES]
    for sample, (d, frame) in enumerate(zip(found, frames, strict=True)):
        boxes, labels, scores = confident(d, 0.0)
        predictions.append(_columns(sample, boxes, label=labels, score=scores))
        truths.append(_columns(sample, frame.boxes, label=frame.labels, num_points=frame.num_points))
    tokens = tuple(names or map(str, range(len(truths) - 1)))
    ego, rack_axes = np.zeros((len(tokens), 3)), np.zeros((0, 3, 3))
    return join(predictions), GroundTruth(tokens, ego, join(truths), NO_BOXES, rack_axes)


def _columns(sample: int, boxes: np.ndarray, **columns: np.ndarray) -> BoxColumns:
    boxes = np.asarray(boxes, np.float64).reshape(-1, 9)
    centre, size, yaw, velocity = boxes[:, :3], boxes[:, [4, 3, 5]], boxes[:, 6], boxes[:, 7:9]
    return make_columns(sample=sample, translation=centre, size=size, yaw=yaw, velocity=velocity, **columns)


def write_detections(path: Path, frames: Iterable[tuple[str, bytes]], classes: Sequence[str]) -> None:
    """Write detections: ``{"classes", "frames": [{"name", "boxes": [{"label", "score", "box"}]}]}``.

    ``frames`` are names with their boxes as JSON, see :func:`fcos_lidar_jax.evaluation.records.as_records`.
    """
    lines = (b'{"name": %s, "boxes": %s}' % (json.dumps(name).encode(), boxes) for name, boxes in frames)
    write_lines(path, b'{"classes": %s, "frames": [' % json.dumps(list(classes)).encode(), lines, b"]}\n")


class _Box(msgspec.Struct, gc=False):
    label: str
    score: float
    box: tuple[float, float, float, float, float, float, float, float | None, float | None]


class _FrameBoxes(msgspec.Struct, gc=False):
    name: str
    boxes: list[_Box]


class _DetectionsFile(msgspec.Struct, gc=False):
    frames: list[_FrameBoxes]


def read_detections(path: Path, names: Sequence[str], classes: Sequence[str]) -> list[Detections]:
    """Read a file of :func:`write_detections` in the order of ``names``, which it must cover exactly.

    ``classes`` are the class names by label.
    """
    by_name: dict[str, list[_Box]] = {}
    for frame in read_source(path, _DetectionsFile)[0].frames:
        if frame.name in by_name:
            raise ValueError(f"{path}: frame {frame.name}: occurs twice")
        by_name[frame.name] = frame.boxes
    expect_samples(by_name, names, str(path), of="the data")
    found = []
    for name in names:
        boxes, where = by_name[name], f"{path}: frame {name}"
        labels = index_of(boxes, "label", {name: label for label, name in enumerate(classes)}, where)
        columns = np.array([box.box for box in boxes], np.float64).reshape(-1, 9)
        near = ~(np.abs(columns) > FARTHEST_M).any(axis=1)
        expect(near, boxes, "box", where, f"numbers of at most {FARTHEST_M:g}")
        positive = (columns[:, 3:6] >= np.finfo(np.float32).tiny).all(axis=1)
        expect(positive, boxes, "box", where, "three positive sizes")
        scores = np.array([box.score for box in boxes])
        expect((scores >= 0) & (scores <= FARTHEST_M), boxes, "score", where, "a number of at least 0")
        arrays: Any = columns.astype(np.float32), scores.astype(np.float32), labels.astype(np.int32)
        rest: Any = {"valid": np.ones(len(boxes), bool), "num_dropped": np.int32(0)}
        found.append(Detections(*arrays, **rest))
    return found
