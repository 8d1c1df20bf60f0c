"""Detections of many frames in a results file, written by a run that can be interrupted and resumed."""

import contextlib
import json
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax.config import config_to_json
from fcos_lidar_jax.data.cloud_policy import no_usable_points, unusable_clouds
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.devices.agreement import agreed, check_same
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.inference.prediction import Prediction, predict_groups
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.types import Detections

_REASONS = ("close", "invalid", "truncated")  # reasons for removing points


def write_predictions(
    detector: CloudDetector,
    frames: FrameSet,
    path: Path,
    *,
    entries: Callable[[int, Detections], list[dict[str, Any]]],
    write: Callable[[Path, Iterator[tuple[str, bytes]]], None],
    batch_size: int = 1,
    yaw_rad: float | None = None,
    notes: tuple[str, ...] = (),
) -> dict[str, int]:
    """Detect boxes in all frames, whose names are unique, and write a results file.

    A resume log next to the file keeps the detections of finished frames until the file is written, except for
    frames without usable points: a resumed run reads and counts them again. Several processes share the frames,
    and the first writes; the path is the same for all. A SIGTERM to any process stops all after the same frames.

    Args:
        entries: converts the index of a frame and its detections to the entries of the file.
        write: writes the file from names of frames with entries as JSON.
        batch_size, yaw_rad, notes: see :func:`fcos_lidar_jax.inference.prediction.predict_groups`.

    Returns:
        number of points removed by all processes in this run, by reason: ``close``, ``invalid``, ``truncated``.

    Raises:
        ValueError: no frame has usable points.
        ValueError, OSError: the processes have different detectors or frames; another process failed.
        SystemExit: after SIGTERM, in a cluster.
    """
    file = path.with_name(f"{path.stem}.resume_log")
    removed, unusable = [0] * len(_REASONS), dict[str, tuple[str, Any]]()
    with contextlib.ExitStack() as held:
        log = None
        with agreed("cannot detect"):
            names = [frames.name(index) for index in range(len(frames))]
            shared = detections_fingerprint(detector, names, batch_size, yaw_rad)
            if jax.process_index() == 0:
                log = held.enter_context(ResumeLog(file, _fingerprint(detector, frames, batch_size, yaw_rad)))
        check_same(shared, "detector, frames or batch size")
        done = multihost_utils.broadcast_one_to_all(np.array([log is not None and name in log for name in names]))
        progress = Progress("frames", len(frames))
        if log is not None:
            progress.show(len(log))
        how: dict[str, Any] = {"batch_size": batch_size, "yaw_rad": yaw_rad, "notes": notes}
        groups = predict_groups(detector, frames, indices=np.flatnonzero(~done).tolist(), **how)
        number = 0
        for number, group in enumerate(groups, 1):
            removed = [sum(counts) for counts in zip(removed, *map(_removed, group), strict=True)]
            lines = [_unusable(detector, names[prediction.index], prediction) for prediction in group]
            without = _in_any_process([line is not None for line in lines])
            with agreed("cannot write"):
                if log is not None:
                    for prediction, line, is_unusable in zip(group, lines, without, strict=True):
                        name, found = names[prediction.index], entries(prediction.index, prediction.detections)
                        if is_unusable:
                            unusable[name] = line or f"{name}: no usable points", found
                        else:
                            log.add(name, found)
                        progress.show(len(log) + len(unusable))
            _stop_after_sigterm(number)
        _stop_after_sigterm(number + 1)  # if it arrived during the last group
        with agreed("cannot write"):
            if log is not None:
                if len(unusable) == len(frames):
                    file.unlink(missing_ok=True)
                if line := unusable_clouds([line for line, _ in unusable.values()], len(frames)):
                    tell(f"note: {line}")
                write(path, _in_order(names, log, {name: found for name, (_, found) in unusable.items()}))
                file.unlink(missing_ok=True)
    return dict(zip(_REASONS, _sum_over_processes(removed), strict=True))


def _stop_after_sigterm(number: int) -> None:
    """In a cluster, even with one process, JAX handles SIGTERM and notifies all processes.

    All processes must call this function with the same numbers.
    """
    if jax.distributed.is_initialized() and multihost_utils.reached_preemption_sync_point(number):
        raise SystemExit(128 + signal.SIGTERM)


def _unusable(detector: CloudDetector, name: str, prediction: Prediction) -> str | None:
    """A line about a cloud without usable points that this process has read, or None."""
    if prediction.cloud is None:
        return None
    return no_usable_points(name, prediction.cloud, int(prediction.detections.num_dropped), detector.sensor)


def _in_any_process(flags: list[bool]) -> list[bool]:
    """Whether each flag is set in any process."""
    return multihost_utils.process_allgather(np.array(flags)[None], tiled=True).any(axis=0).tolist()


def _in_order(names: Sequence[str], log: ResumeLog, others: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """Names with entries as JSON, from the log and from the ``others``, which are not in it."""
    for name in names:
        if name in others:
            yield name, json.dumps(others[name]).encode()
        else:
            yield from log.entries([name])


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
    """Checksum of everything detections depend on: weights, configuration, sensor, and other values, as JSON."""
    inputs = detector.fingerprint, config_to_json(detector.config), sensor_to_json(detector.sensor), *others
    return checksum(json.dumps(inputs, sort_keys=True).encode())


def _fingerprint(detector: CloudDetector, frames: FrameSet, batch_size: int, yaw_rad: float | None) -> str:
    data = frames.fingerprint(), frames.clouds_fingerprint(range(len(frames))), sensor_to_json(frames.sensor)
    return detections_fingerprint(detector, *data, batch_size, yaw_rad)
