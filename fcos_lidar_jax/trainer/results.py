"""Detections of many frames in a results file; an interrupted run resumes."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from fcos_lidar_jax.config import config_to_json
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.trainer.prediction import predict
from fcos_lidar_jax.types import Detections


def write_predictions(
    detector: CloudDetector,
    frames: FrameSet,
    path: Path,
    *,
    entries: Callable[[int, Detections], list[dict[str, Any]]],
    write: Callable[[Path, Iterator[tuple[str, bytes]]], None],
    batch_size: int = 1,
) -> dict[str, int]:
    """Detect in every frame and write a results file.

    What is done is kept in a resume log beside the file, which is removed when the file is written.

    Args:
        detector, frames: network with its weights, and what to detect in; the frames' names differ.
        path: of the results file.
        entries: index of a frame and its detections -> what the file shall hold of them.
        write: writes the file from the frames' names with their entries as JSON.
        batch_size: as in :func:`fcos_lidar_jax.trainer.prediction.predict`.

    Returns:
        points that were removed in this run and why: ``close``, ``invalid``, ``truncated``.
    """
    file, removed = path.with_name(f"{path.stem}.resume_log"), {"close": 0, "invalid": 0, "truncated": 0}
    names = [frames.name(index) for index in range(len(frames))]
    with ResumeLog(file, _fingerprint(detector, frames, batch_size)) as log:
        todo = [index for index, name in enumerate(names) if name not in log]
        progress = Progress("frames", len(frames))
        progress.show(len(log))
        for prediction in predict(detector, frames, indices=todo, batch_size=batch_size):
            log.add(names[prediction.index], entries(prediction.index, prediction.detections))
            for reason in removed:
                removed[reason] += getattr(prediction.cloud, f"num_{reason}", 0)
            progress.show(len(log))
        if jax.process_index() == 0:
            write(path, log.entries(names))
    file.unlink(missing_ok=True)
    return removed


def detections_fingerprint(detector: CloudDetector, *others: object) -> str:
    """Checksum of what detections follow from: weights, configuration, sensor, and other things, as JSON."""
    described = detector.fingerprint, config_to_json(detector.config), sensor_to_json(detector.sensor), *others
    return checksum(json.dumps(described, sort_keys=True).encode())


def _fingerprint(detector: CloudDetector, frames: FrameSet, batch_size: int) -> str:
    """That of the detections in frames, of which so many are computed at once."""
    seen = frames.fingerprint(), frames.clouds_fingerprint(range(len(frames)))
    return detections_fingerprint(detector, *seen, batch_size)
