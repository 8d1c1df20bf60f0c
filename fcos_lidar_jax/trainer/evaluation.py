"""How well a detector does on frames."""

from collections.abc import Sequence
from typing import Any

from fcos_lidar_jax.data.classes import MappedFrames
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import Evaluation, metric_of
from fcos_lidar_jax.inference.detector import TrainedDetector
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.trainer.prediction import predict


def evaluate(
    detector: TrainedDetector,
    frames: FrameSet,
    *,
    batch_size: int = 1,
    devices: Sequence[Any] | None = None,
) -> Evaluation:
    """Detect in every frame and compare with its boxes, by centre distance.

    Args:
        detector: network and weights.
        frames: with boxes; classes are matched by name, boxes of other classes are left out.
        batch_size: as in :func:`predict`.
        devices: as in :func:`predict`.

    Returns:
        precision and errors over the detector's classes, see
        :func:`fcos_lidar_jax.evaluation.frames.evaluate_frames`.
    """
    mapped = MappedFrames(frames, detector.classes)
    progress = Progress("test frames", len(mapped))
    found, truths = [], []
    for prediction in predict(detector, mapped, batch_size=batch_size, devices=devices):
        frame = prediction.frame or mapped.frame(prediction.index)
        found.append(prediction.detections)
        truths.append(Frame(frame.points[:0], frame.boxes, frame.labels, frame.num_points))
        progress.show(len(found))
    return evaluate_frames(found, truths, metric_of(detector.classes, tuple(detector.config.ranges_m.values())))
