"""Detections of many frames in a results file, written by a run that can be interrupted and resumed."""

import contextlib
import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax import __version__
from fcos_lidar_jax.config import config_to_json
from fcos_lidar_jax.data.cloud_policy import unusable_clouds
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.files import checksum, file_lock
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.inference.loop import Prediction
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import sensor_to_json

_REASONS = ("close", "invalid", "truncated")  # reasons for removing points


def write_predictions(
    detector: CloudDetector,
    frames: FrameSet,
    path: Path,
    *,
    entries: Callable[[Prediction], tuple[list[dict[str, Any]], str]],
    write: Callable[[Path, Iterator[tuple[str, bytes]]], None],
    options: object = None,
    unit: str = "frames",
    **how: Any,
) -> dict[str, int]:
    """Detect boxes in all frames, whose names are unique, and write a results file.

    A resume log next to the file keeps the detections of finished frames until the file is written, except for
    frames without usable points: a resumed run detects in them again, and in frames whose files have changed.
    Several processes share the frames, and the first writes; the path is the same for all. A SIGTERM to any
    process stops all after the same frames.

    Args:
        entries: converts a prediction to the entries of the file, and a text for the line of progress.
        write: writes the file from names of frames with entries as JSON.
        options: what else the entries depend on, as JSON.
        unit: what frames are called, for the line of progress.
        how: ``batch_size``, ``yaw_rad`` and ``notes`` of :func:`fcos_lidar_jax.inference.predict`.

    Returns:
        number of points removed by all processes in this run, by reason: ``close``, ``invalid``, ``truncated``.

    Raises:
        ValueError: no frame has usable points.
        ValueError, OSError: the processes have different detectors or frames; another process failed.
        SystemExit: after SIGTERM, in a cluster.
    """
    removed, number, finished = [0] * len(_REASONS), 0, None
    with contextlib.ExitStack() as held:
        with agreed("cannot detect"):
            same, names = (how.get("batch_size", 1), how.get("yaw_rad")), [*map(frames.name, range(len(frames)))]
            frames.check_files(range(len(names)))
            if jax.process_index() == 0:
                log = held.enter_context(_open_log(path, _fingerprint(detector, frames, *same, options)))
                finished = _Finished(log, frames, names, unit)
        check_same(detections_fingerprint(detector, names, *same), "versions, detector, frames or batch size")
        todo = np.ones(len(names), bool) if finished is None else finished.todo
        how["indices"] = np.flatnonzero(multihost_utils.broadcast_one_to_all(todo)).tolist()
        for number, prediction in enumerate(predict(detector, frames, **how), 1):
            removed = [sum(counts) for counts in zip(removed, _removed(prediction), strict=True)]
            unusable = _in_any_process(prediction.note is not None)
            with agreed("cannot write"):
                if finished is not None:
                    finished.add(prediction, *entries(prediction), unusable=unusable)
            _stop_after_sigterm(number)
        _stop_after_sigterm(number + 1)  # if it arrived during the last group
        with agreed("cannot write"):
            if finished is not None:
                write(path, finished.entries())
                finished.log.discard()
    return dict(zip(_REASONS, _sum_over_processes(removed), strict=True))


class _Finished:
    """The log of finished frames, without those that have no usable points until all are finished."""

    def __init__(self, log: ResumeLog, frames: FrameSet, names: list[str], unit: str) -> None:
        self.log, self.names, self.unusable = log, names, dict[str, tuple[str, list[dict[str, Any]]]]()
        self.keys = [f"{name}\t{frames.clouds_fingerprint([index])}" for index, name in enumerate(names)]
        self.todo = np.array([key not in log for key in self.keys], bool)
        self.number, self.progress = len(self.keys) - int(self.todo.sum()), Progress(unit, len(frames))
        if self.number:
            self.progress.show(self.number, "detected before")

    def add(self, prediction: Prediction, found: list[dict[str, Any]], text: str, *, unusable: bool) -> None:
        key = self.keys[prediction.index]
        if unusable:
            line = prediction.note or f"{self.names[prediction.index]}: no usable points"
            self.unusable[key] = line, found
        else:
            self.log.add(key, found)
        self.number += 1
        self.progress.show(self.number, text)

    def entries(self) -> Iterator[tuple[str, bytes]]:
        """Names with entries as JSON, in order. Refuses frames of which none has usable points."""
        if len(self.unusable) == len(self.keys):
            self.log.discard()
        if line := unusable_clouds([line for line, _ in self.unusable.values()], len(self.keys)):
            tell(f"note: {line}")
        for key, (_, found) in self.unusable.items():
            self.log.add(key, found)
        return ((name, self.log.entry(key)) for name, key in zip(self.names, self.keys, strict=True))


@contextlib.contextmanager
def _open_log(path: Path, fingerprint: str) -> Iterator[ResumeLog]:
    """The resume log beside a results file, or a folder of them."""
    named = path if path.name else path.absolute()  # such as "."
    file = named.with_name(f".{named.name}.resume_log")
    with file_lock(file) as held:
        if not held:
            raise BlockingIOError(f"{path}: in use: another process is detecting, expected no other process")
        with ResumeLog(file, fingerprint) as log:
            yield log


def _stop_after_sigterm(number: int) -> None:
    """In a cluster, even with one process, JAX handles SIGTERM and notifies all processes.

    All processes must call this function with the same numbers.
    """
    if jax.distributed.is_initialized() and multihost_utils.reached_preemption_sync_point(number):
        raise SystemExit(128 + signal.SIGTERM)


def _in_any_process(flag: bool) -> bool:
    return bool(multihost_utils.process_allgather(np.array([flag]), tiled=True).any())


def _removed(prediction: Prediction) -> list[int]:
    """Points that this process removed from a cloud, by reason; 0 for a cloud that another process has read."""
    cloud = prediction.cloud
    return [0] * len(_REASONS) if cloud is None else [int(getattr(cloud, f"num_{reason}")) for reason in _REASONS]


def _sum_over_processes(counts: list[int]) -> list[int]:
    """Sum counts below 2**64, each sent as two words, because JAX would truncate it to 32 bits."""
    words = np.array([divmod(count, 2**32) for count in counts], np.uint32)
    of_all = multihost_utils.process_allgather(words[None], tiled=True).astype(object)
    return (of_all[..., 0] * 2**32 + of_all[..., 1]).sum(axis=0).tolist()


def detections_fingerprint(detector: CloudDetector, *others: object) -> str:
    """Checksum of everything detections depend on: weights, configuration, sensor, versions, and other values."""
    inputs = detector.fingerprint, config_to_json(detector.config), sensor_to_json(detector.sensor), *others
    return checksum(json.dumps((__version__, jax.__version__, *inputs), sort_keys=True).encode())


def _fingerprint(detector: CloudDetector, frames: FrameSet, *how: object) -> str:
    return detections_fingerprint(detector, frames.fingerprint(), sensor_to_json(frames.sensor), *how)
