"""Evaluation of frames from anywhere: boxes in the sensor's frame, no tokens, no racks, no attributes."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.sweeps import FARTHEST_M
from fcos_lidar_jax.evaluation.boxes import NO_BOXES, BoxColumns, GroundTruth, join, make_columns
from fcos_lidar_jax.evaluation.json_io import expect, expect_samples, index_of, read_json
from fcos_lidar_jax.evaluation.metrics import Evaluation, Metric, evaluate
from fcos_lidar_jax.evaluation.records import confident
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.types import Detections


def evaluate_frames(found: Iterable[Detections], frames: Iterable[Frame], metric: Metric) -> Evaluation:
    """Evaluate detections against the boxes of their frames; the score is the mAP by centre distance.

    It differs from the nuScenes benchmark: ranges count from the sensor and not from the ego vehicle, boxes count
    by their LiDAR points alone, there are no bicycle racks, attributes and NDS, and means are over the classes
    that occur in the truth.

    Args:
        found: NumPy arrays, one for each frame, labels by the metric's classes.
        frames: with the truth, labels likewise; boxes without a point do not count. Points are not looked at.
        metric: of :func:`fcos_lidar_jax.evaluation.metrics.metric_of`.

    Raises:
        ValueError: the metric is the benchmark's.

    >>> from fcos_lidar_jax.evaluation.metrics import metric_of
    >>> frame = Frame(np.zeros((0, 5)), np.ones((1, 9)), np.zeros(1, int), np.ones(1, int))
    >>> exact = Detections(frame.boxes, np.ones(1), frame.labels, np.ones(1, bool), np.zeros(0))
    >>> round(evaluate_frames([exact], [frame], metric_of(["car", "tram"])).summary["mean_ap"], 9)
    1.0
    """
    if metric.benchmark:
        raise ValueError(
            "metric: got the nuScenes benchmark's, expected one of metric_of: frames have no attributes"
        )
    return evaluate(*frame_columns(found, frames), metric)


def frame_columns(
    found: Iterable[Detections], frames: Iterable[Frame], names: Sequence[str] = ()
) -> tuple[BoxColumns, GroundTruth]:
    """Detections and truth of frames as columns, with the sensors' frames as the global one.

    The samples are called by the names; by default they are numbered.
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
    """Boxes ``x, y, z, l, w, h, yaw, vx, vy`` of one sample."""
    boxes = np.asarray(boxes, np.float64).reshape(-1, 9)
    centre, size, yaw, velocity = boxes[:, :3], boxes[:, [4, 3, 5]], boxes[:, 6], boxes[:, 7:9]
    return make_columns(sample=sample, translation=centre, size=size, yaw=yaw, velocity=velocity, **columns)


def write_detections(path: Path, frames: Iterable[tuple[str, bytes]], classes: Sequence[str]) -> None:
    """Write detections: ``{"classes", "frames": [{"name", "boxes": [{"label", "score", "box"}]}]}``.

    Args:
        frames: names with their boxes as JSON, see :func:`fcos_lidar_jax.evaluation.records.as_records`.
    """
    lines = (b'{"name": %s, "boxes": %s}' % (json.dumps(name).encode(), boxes) for name, boxes in frames)
    text = b'{"classes": %s, "frames": [\n%s\n]}\n' % (json.dumps(list(classes)).encode(), b",\n".join(lines))
    atomic_write(path, lambda file: file.write_bytes(text))


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
    """Read what :func:`write_detections` wrote, in the order of the names.

    Args:
        names: of the frames that it must cover, no more and no less.
        classes: that the labels shall index.

    Raises:
        ValueError: naming the file, the frame, the box (from 0) and what is wrong.
    """
    by_name: dict[str, list[_Box]] = {}
    for frame in read_json(path, _DetectionsFile)[0].frames:
        if frame.name in by_name:
            raise ValueError(f"{path}: frame {frame.name}: occurs twice")
        by_name[frame.name] = frame.boxes
    expect_samples(by_name, names, str(path), of="the data")
    found = []
    for name in names:
        boxes, where = by_name[name], f"{path}: frame {name}"
        labels = index_of(boxes, "label", {known: label for label, known in enumerate(classes)}, where)
        columns = np.array([box.box for box in boxes], np.float64).reshape(-1, 9)
        near = ~(np.abs(columns) > FARTHEST_M).any(axis=1)
        expect(near, boxes, "box", where, f"numbers of at most {FARTHEST_M:g}")
        expect(
            (columns[:, 3:6] >= np.finfo(np.float32).tiny).all(axis=1), boxes, "box", where, "three positive sizes"
        )
        unknown = np.isnan(columns[:, 7:])
        expect(unknown[:, 0] == unknown[:, 1], boxes, "box", where, "a velocity of two numbers or of two nulls")
        scores = np.array([box.score for box in boxes])
        expect((scores >= 0) & (scores <= FARTHEST_M), boxes, "score", where, "a number of at least 0")
        arrays: Any = (
            columns.astype(np.float32),
            scores.astype(np.float32),
            labels.astype(np.int32),
            np.ones(len(boxes), bool),
            np.int32(0),
        )
        found.append(Detections(*arrays))
    return found
