"""Detections of many frames in a results file; an interrupted run resumes."""

import contextlib
import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax.config import config_to_json
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.inference.prediction import Prediction, predict_groups
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.types import Detections

_REMOVED = ("close", "invalid", "truncated")  # Why points were removed.


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

    What is done is kept in a resume log beside the file, which is removed when the file is written. Several
    processes share the frames, and the first writes; the path is the same for all. SIGTERM to any of them stops
    all after the same frames.

    Args:
        detector, frames: network with its weights, and what to detect in; the frames' names differ.
        path: of the results file.
        entries: index of a frame and its detections -> what the file shall hold of them.
        write: writes the file from the frames' names with their entries as JSON.
        batch_size: as in :func:`fcos_lidar_jax.inference.prediction.predict`.

    Returns:
        points that were removed in this run, by all processes, and why: ``close``, ``invalid``, ``truncated``.

    Raises:
        ValueError: the processes have different detectors or frames.
        OSError: another process failed.
        SystemExit: after SIGTERM, in a cluster.
    """
    file = path.with_name(f"{path.stem}.resume_log")
    removed = [0] * len(_REMOVED)
    with contextlib.ExitStack() as held:
        log = None
        with agreed("cannot detect"):
            names = [frames.name(index) for index in range(len(frames))]
            same = detections_fingerprint(detector, names, batch_size)
            if jax.process_index() == 0:
                log = held.enter_context(ResumeLog(file, _fingerprint(detector, frames, batch_size)))
        check_same(same, "detector, frames or batch size")
        done = multihost_utils.broadcast_one_to_all(np.array([log is not None and name in log for name in names]))
        progress = Progress("frames", len(frames))
        if log is not None:
            progress.show(len(log))
        groups = predict_groups(detector, frames, indices=np.flatnonzero(~done).tolist(), batch_size=batch_size)
        number = 0
        for number, group in enumerate(groups, 1):
            removed = [sum(counts) for counts in zip(removed, *map(_removed, group), strict=True)]
            with agreed("cannot write"):
                if log is not None:
                    for prediction in group:
                        log.add(names[prediction.index], entries(prediction.index, prediction.detections))
                        progress.show(len(log))
            _stop_after_sigterm(number)
        _stop_after_sigterm(number + 1)  # If it came in the last group.
        with agreed("cannot write"):
            if log is not None:
                write(path, log.entries(names))
                file.unlink(missing_ok=True)
    return dict(zip(_REMOVED, _sum_over_processes(removed), strict=True))


def _stop_after_sigterm(number: int) -> None:
    """In a cluster, even of one process, JAX has taken SIGTERM from Python, and tells all processes of it.

    Args:
        number: of groups done; every process calls this with the same numbers.
    """
    if jax.distributed.is_initialized() and multihost_utils.reached_preemption_sync_point(number):
        raise SystemExit(128 + signal.SIGTERM)


def _removed(prediction: Prediction) -> list[int]:
    """Points that this process removed from a cloud, by reason; of one that another has read, none."""
    cloud = prediction.cloud
    return [0] * len(_REMOVED) if cloud is None else [int(getattr(cloud, f"num_{reason}")) for reason in _REMOVED]


def _sum_over_processes(counts: list[int]) -> list[int]:
    """Sums of counts below 2**64, which travel as two words: JAX would keep 32 bits."""
    words = np.array([divmod(count, 2**32) for count in counts], np.uint32)
    of_all = multihost_utils.process_allgather(words[None], tiled=True).astype(object)
    return (of_all[..., 0] * 2**32 + of_all[..., 1]).sum(axis=0).tolist()


def detections_fingerprint(detector: CloudDetector, *others: object) -> str:
    """Checksum of what detections follow from: weights, configuration, sensor, and other things, as JSON."""
    described = detector.fingerprint, config_to_json(detector.config), sensor_to_json(detector.sensor), *others
    return checksum(json.dumps(described, sort_keys=True).encode())


def _fingerprint(detector: CloudDetector, frames: FrameSet, batch_size: int) -> str:
    """That of the detections in frames, of which so many are computed at once."""
    seen = frames.fingerprint(), frames.clouds_fingerprint(range(len(frames)))
    return detections_fingerprint(detector, *seen, batch_size)
