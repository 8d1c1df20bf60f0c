"""The benchmark's metric on frames that come from anywhere: boxes in the sensor's frame, no tokens, no racks."""

from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation.boxes import UNKNOWN_POINTS, BoxColumns, GroundTruth, join, no_racks
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.types import Detections


def evaluate_frames(found: Sequence[Detections], frames: Sequence[Frame]) -> Evaluation:
    """Evaluate detections against the boxes of their frames.

    The ranges of the classes count from the sensor, and nothing is known of attributes, whose error is 1.

    Args:
        found: NumPy arrays, one for each frame.
        frames: with the truth; boxes without a point do not count.

    >>> frame = Frame(np.zeros((0, 5)), np.ones((1, 9)), np.zeros(1, int), np.ones(1, int))
    >>> one = np.ones(1, bool)
    >>> exact = Detections(frame.boxes, np.ones(1), frame.labels, one, np.zeros(0))
    >>> round(evaluate_frames([exact], [frame]).summary["mean_dist_aps"]["car"], 9)
    1.0
    """
    predictions, truths = [], []
    for sample, (d, frame) in enumerate(zip(found, frames, strict=True)):
        valid = np.asarray(d.valid)
        boxes, labels, scores = (np.asarray(column)[valid] for column in (d.boxes, d.labels, d.scores))
        unknown = np.full(len(boxes), UNKNOWN_POINTS)
        predictions.append(_columns(sample, boxes, labels, scores, unknown))
        truths.append(
            _columns(sample, frame.boxes, frame.labels, np.full(len(frame.boxes), -1.0), frame.num_points)
        )
    truth = GroundTruth(
        tokens=tuple(map(str, range(len(frames)))),
        ego_translation=np.zeros((len(frames), 3)),
        boxes=join(truths),
        racks=no_racks(),
    )
    return evaluate(join(predictions), truth)


def _columns(
    sample: int, boxes: np.ndarray, labels: np.ndarray, scores: np.ndarray, num_points: np.ndarray
) -> BoxColumns:
    """Boxes ``x, y, z, l, w, h, yaw, vx, vy`` of one sample."""
    boxes = np.asarray(boxes, np.float64)
    return BoxColumns(
        sample=np.full(len(boxes), sample, np.int32),
        label=np.asarray(labels, np.int8),
        translation=boxes[:, :3],
        size=boxes[:, [4, 3, 5]],
        yaw=boxes[:, 6],
        velocity=boxes[:, 7:9],
        attribute=np.full(len(boxes), -1, np.int8),
        score=np.asarray(scores, np.float64),
        num_points=np.asarray(num_points, np.int32),
    )
