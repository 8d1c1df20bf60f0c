"""Detection in a drive, sweep by sweep, with a rolling window of sweeps and one compiled program."""

import dataclasses
import functools
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.cloud_policy import Cloud, unusable_cloud
from fcos_lidar_jax.data.frame import unlabelled
from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.inference.alignment import Alignment, align
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.inference.loop import Prediction, Request, detect_clouds
from fcos_lidar_jax.sensors import Sensor


def detect_stream(
    sweeps: Iterable[Sweep],
    detector: CloudDetector,
    *,
    reading: CloudReading | None = None,
    at_us: Collection[int] | None = None,
    sensor: Sensor | None = None,
    yaw_rad: float | None = None,
    aligned: Alignment | None = None,
) -> Iterator[Prediction]:
    """Detect boxes in every sweep as it arrives, fused with the sweeps before it.

    The boxes are bit-identical to ``fcos-lidar detect --sweeps`` with the same sweeps. A sweep without usable
    points has no boxes, whatever the sweeps before it.

    Args:
        sweeps: sweeps, in temporal order if they are fused; may be an iterator that waits for the next sweep.
        reading: number of sweeps to fuse and points to drop; by default as in training. Use one sweep if the poses
            are unknown.
        at_us: times of the sweeps to detect in; other sweeps are only fused into later ones. By default all.
        sensor: sensor that recorded the sweeps, by default the detector's. Sweeps of other sensors are rotated and
            shifted.
        yaw_rad: rotation of the sweeps about z before detection, undone for the boxes, instead of the angle
            between the headings: pi / 2 if x points forward in the sweeps and y in the training data. Detection
            degrades for orientations absent from training.
        aligned: instead of ``sensor`` and ``yaw_rad``.

    Raises:
        ValueError: names a sweep that is to be fused with others and is not later than the sweep before.

    >>> import numpy as np
    >>> from fcos_lidar_jax.data.sweeps import Sweep
    >>> from fcos_lidar_jax.inference import load_detector
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> from fcos_lidar_jax.simulation.frames import make_frame
    >>> sweeps = (Sweep(make_frame(seed, SHORT_RANGE).points, np.eye(4), seed) for seed in range(2))
    >>> [found.sweep.time_us for found in detect_stream(sweeps, load_detector("quickstart"))]
    [0, 1]
    """
    aligned = align(detector.sensor, sensor, yaw_rad=yaw_rad) if aligned is None else aligned
    requests = _requests(sweeps, aligned.data, reading or detector.config.reading, at_us)
    how: dict[str, Any] = {"devices": jax.local_devices()[:1], "ahead": 0}
    for found in detect_clouds(detector.program, detector.config, aligned, requests, **how):
        cloud, note, detections = found.cloud, found.note, found.detections
        assert cloud is not None
        assert found.sweep is not None
        note = note or only_older(found.sweep.name, cloud, aligned.detector)
        if note is not None:
            detections = dataclasses.replace(detections, valid=np.zeros_like(detections.valid))
        yield dataclasses.replace(found, detections=detections, note=note)


def only_older(name: str | Path, cloud: Cloud, sensor: Sensor) -> str | None:
    """A line about fused sweeps, of which only older ones have points in the range image, or None."""
    lag = cloud.points[:, 4]
    now = cloud.valid & (lag == 0)
    if not (lag[cloud.valid] > 0).any() or unusable_cloud(name, cloud.points[now], now[now], 0, sensor) is None:
        return None
    return f"{name}: only older sweeps have usable points"


def _requests(
    sweeps: Iterable[Sweep], sensor: Sensor, reading: CloudReading, at_us: Collection[int] | None
) -> Iterator[Request]:
    window: deque[Sweep] = deque(maxlen=reading.num_sweeps)
    for index, sweep in enumerate(sweeps):
        if reading.num_sweeps > 1 and window and sweep.time_us <= window[0].time_us:
            before = f"the {window[0].time_us} us of the sweep before, {window[0].name}"
            raise ValueError(f"{sweep.name}: time: got {sweep.time_us} us, expected more than {before}")
        window.appendleft(sweep)
        if at_us is None or sweep.time_us in at_us:
            fused = functools.partial(fuse_sweeps, [*window], sensor, reading)
            yield Request(index, sweep.name, lambda fused=fused: unlabelled(*fused()), sweep)
