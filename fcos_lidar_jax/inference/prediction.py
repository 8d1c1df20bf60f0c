"""Detection in many frames, read ahead and spread over the devices, and its evaluation."""

import dataclasses
import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.cloud_policy import Cloud, make_cloud, sensor_mismatch, tell_truncation
from fcos_lidar_jax.data.frame import Frame, FrameSet, check_frames, without_points
from fcos_lidar_jax.devices.agreement import agreed
from fcos_lidar_jax.devices.mesh import make_mesh, shard_batch
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import Evaluation, metric_of
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.inference.alignment import Alignment
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.types import Detections

_AHEAD = 2  # number of groups of frames to read ahead of the devices


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Detections in one frame.

    >>> nothing = Detections(*np.zeros((3, 0)), valid=np.zeros(0, bool), num_dropped=np.int32(0))
    >>> Prediction(7, nothing, frame=None, cloud=None).detections.valid.sum()
    np.int64(0)
    """

    index: int  # index of the frame
    detections: Detections  # NumPy arrays, in the frame of the data
    frame: Frame | None  # the frame; None if another process has read it
    cloud: Cloud | None  # input of the network, with counts of dropped points; None if another process has read it


def predict(
    detector: CloudDetector,
    frames: FrameSet,
    *,
    indices: Sequence[int] | None = None,
    batch_size: int = 1,
    devices: Sequence[Any] | None = None,
    yaw_rad: float | None = None,
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

    Raises:
        ValueError: a batch size below 1, or a frame that cannot be read.

    >>> from fcos_lidar_jax.inference import load_detector
    >>> from fcos_lidar_jax.simulation.frame_set import unseen_frames
    >>> detector = load_detector("quickstart")
    >>> [found.detections.boxes.shape for found in predict(detector, unseen_frames(detector.sensor, 2))]
    [(500, 9), (500, 9)]
    """
    how: dict[str, Any] = {"batch_size": batch_size, "devices": devices, "yaw_rad": yaw_rad}
    for group in predict_groups(detector, frames, indices=indices, **how):
        yield from group


def predict_groups(
    detector: CloudDetector,
    frames: FrameSet,
    *,
    indices: Sequence[int] | None = None,
    batch_size: int = 1,
    devices: Sequence[Any] | None = None,
    yaw_rad: float | None = None,
    notes: tuple[str, ...] = (),
) -> Iterator[list[Prediction]]:
    """Like :func:`predict`, in groups of frames that the devices process together.

    ``notes`` are lines to print after the first frames are read, once per process.
    Processes can synchronise between two groups; if another one cannot read its frames, an OSError says so.
    """
    check(batch_size >= 1, "batch_size", batch_size, "at least 1")
    check_frames(frames)
    mesh, config, sensor = make_mesh(devices), detector.config, detector.sensor
    aligned = Alignment(frames.sensor, sensor, yaw_rad, notes)
    program = detector.program(mesh, batch_size)
    todo = list(range(len(frames)) if indices is None else indices)
    size = batch_size * mesh.size
    groups = [todo[i : i + size] for i in range(0, len(todo), size)]
    own_rows = [r for r in range(size) if mesh.devices[r // batch_size].process_index == jax.process_index()]

    def read(group: list[int]) -> tuple[dict[int, tuple[Frame, Cloud]], tuple[np.ndarray, np.ndarray]]:
        shape = (len(own_rows), config.max_points, sensor.point_columns)
        points, valid = np.zeros(shape, np.float32), np.zeros(shape[:2], bool)
        loaded = {}
        for slot, row in enumerate(own_rows):
            if row < len(group):
                frame = frames.frame(group[row])
                given = aligned.points(frame.points)
                cloud = make_cloud(given, config, sensor=sensor, num_close=frame.num_close)
                tell_truncation(frames.name(group[row]), cloud, config)
                points[slot], valid[slot] = cloud.points, cloud.valid
                loaded[row] = frame, cloud
        return loaded, (points, valid)

    def collect(group: list[int], loaded: dict[int, tuple[Frame, Cloud]], outputs: Any) -> list[Prediction]:
        arrays = multihost_utils.process_allgather(outputs, tiled=True) if jax.process_count() > 1 else outputs
        arrays = jax.device_get(arrays)
        rows = (jax.tree.map(lambda leaf, row=row: leaf[row], arrays) for row in range(len(group)))
        return [
            Prediction(group[r], aligned.back(each), *loaded.get(r, (None, None))) for r, each in enumerate(rows)
        ]

    with ThreadPoolExecutor(_AHEAD) as pool:
        reading = deque(pool.submit(read, group) for group in groups[:_AHEAD])
        running: tuple[list[int], dict[int, tuple[Frame, Cloud]], Any] | None = None
        for number, group in enumerate(groups):
            with agreed("cannot read its frames"):
                loaded, clouds = reading.popleft().result()
            if not number:
                _tell_notes(aligned, frames, loaded.values())
            if number + _AHEAD < len(groups):
                reading.append(pool.submit(read, groups[number + _AHEAD]))
            outputs = program(*shard_batch(clouds, mesh))
            if running is not None:
                yield collect(*running)
            running = group, loaded, outputs
        if running is not None:
            yield collect(*running)


def _tell_notes(aligned: Alignment, frames: FrameSet, read: Iterable[tuple[Frame, Cloud]]) -> None:
    """Print lines about the first frames. They were read before, because an error would make the lines moot."""
    aligned.tell_notes()
    if line := aligned.describe():
        tell(line)
    for frame, _ in itertools.islice(read, 1):
        if line := sensor_mismatch(aligned.points(frame.points), aligned.detector):
            tell(f"warning: {line}")


def evaluate(
    detector: CloudDetector, frames: FrameSet, *, batch_size: int = 1, devices: Sequence[Any] | None = None
) -> Evaluation:
    """Evaluate detections in all frames by centre distance; arguments as for :func:`predict`.

    Classes are matched by name; boxes of other classes are ignored.

    Returns:
        scores over the classes of the detector, see :func:`fcos_lidar_jax.evaluation.frames.evaluate_frames`.

    >>> from fcos_lidar_jax.inference import load_detector
    >>> from fcos_lidar_jax.simulation.frame_set import unseen_frames
    >>> detector = load_detector("quickstart")
    >>> 0 <= evaluate(detector, unseen_frames(detector.sensor, 2)).summary["mean_ap"] <= 1
    True
    """
    mapped = MappedFrames(frames, detector.classes)
    progress = Progress("test frames", len(mapped))
    found, truths = list[Detections](), list[Frame]()
    for group in predict_groups(detector, mapped, batch_size=batch_size, devices=devices):
        with agreed("cannot read its boxes"):
            # Without points: the clouds of a data set need not fit into memory.
            truths += [mapped.truth(p.index) if p.frame is None else without_points(p.frame) for p in group]
        found += [prediction.detections for prediction in group]
        if jax.process_index() == 0:
            progress.show(len(found))
    return evaluate_frames(found, truths, metric_of(detector.classes, tuple(detector.config.ranges_m.values())))
