"""Detection in many frames, and its evaluation."""

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import jax

from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.frame import Frame, FrameSet, check_frames, without_points
from fcos_lidar_jax.devices.agreement import agreed
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import Evaluation, Metric
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.inference.alignment import Alignment
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.inference.loop import Prediction, Request, detect_clouds
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.types import Detections


def predict(
    detector: CloudDetector,
    frames: FrameSet,
    *,
    indices: Sequence[int] | None = None,
    batch_size: int = 1,
    devices: Sequence[Any] | None = None,
    yaw_rad: float | None = None,
    notes: tuple[str, ...] = (),
) -> Iterator[Prediction]:
    """Detect boxes in frames, in order.

    Clouds are rotated and shifted to the frame that the detector expects, if the sensors of frames and detector
    differ; one line on standard error reports it. Boxes are in the frame of the data.

    Every device runs the program for a single cloud, so the boxes are bit-identical for any number of devices and
    processes. Threads read frames while the devices work.

    Args:
        indices: indices of the frames to process; by default all.
        batch_size: number of clouds per device; more than one changes scores and boxes by rounding, at most 1e-4.
        devices: devices to use; by default all, including those of other processes. Then every process makes the
            same call, reads its share of the frames, and gets all predictions.
        yaw_rad: rotation of the clouds about z before detection, undone for the boxes, counter-clockwise; by
            default the angle between the headings of the sensors.
        notes: lines to print once the first frame was read, once per process.

    Raises:
        ValueError: a batch size below 1, or frames that cannot be read; missing files, before the first is.

    >>> from fcos_lidar_jax.inference import load_detector
    >>> from fcos_lidar_jax.simulation.frame_set import unseen_frames
    >>> detector = load_detector("quickstart")
    >>> [found.detections.boxes.shape for found in predict(detector, unseen_frames(detector.sensor, 2))]
    [(500, 9), (500, 9)]
    """
    check(batch_size >= 1, "batch_size", batch_size, "at least 1")
    check_frames(frames)
    aligned = Alignment(frames.sensor, detector.sensor, yaw_rad, notes)
    todo = range(len(frames)) if indices is None else indices
    frames.check_files(todo)
    requests = (Request(index, frames.name(index), functools.partial(frames.frame, index)) for index in todo)
    how: dict[str, Any] = {"batch_size": batch_size, "devices": devices}
    return detect_clouds(detector.program, detector.config, aligned, requests, **how)


def evaluate(
    detector: CloudDetector, frames: FrameSet, *, batch_size: int = 1, devices: Sequence[Any] | None = None
) -> Evaluation:
    """Evaluate detections in all frames by centre distance; arguments as for :func:`predict`.

    Classes are matched by name; boxes of other classes are ignored.

    Returns:
        scores over the classes of the detector, see :func:`fcos_lidar_jax.evaluation.frames.evaluate_frames`.
    """
    mapped = MappedFrames(frames, detector.classes)
    progress = Progress("test frames", len(mapped))
    found, truths = list[Detections](), list[Frame]()
    for prediction in predict(detector, mapped, batch_size=batch_size, devices=devices):
        with agreed("cannot read its boxes"):
            # Without points: the clouds of a data set need not fit into memory.
            frame = prediction.frame
            truths.append(mapped.truth(prediction.index) if frame is None else without_points(frame))
        found.append(prediction.detections)
        if jax.process_index() == 0:
            progress.show(len(found))
    return evaluate_frames(found, truths, Metric(detector.config.ranges_m))
