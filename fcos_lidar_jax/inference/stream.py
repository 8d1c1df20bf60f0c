"""Detection in a drive, sweep by sweep, with a rolling window of sweeps and one compiled program."""

import dataclasses
from collections import deque
from collections.abc import Collection, Iterable, Iterator

import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.cloud_policy import Cloud, make_cloud, no_usable_points, tell_truncation
from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.inference.alignment import align
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Detections


@dataclasses.dataclass(frozen=True)
class SweepDetections:
    """Detections in one sweep, fused with the sweeps before it."""

    sweep: Sweep  # the current sweep, unchanged
    cloud: Cloud  # input of the network: the sweeps of the window in the frame of the current one, rotated
    detections: Detections  # NumPy arrays, in the frame of the sweep
    unusable: str | None = None  # a line if the sweep has no usable points, and so no boxes


def detect_stream(
    sweeps: Iterable[Sweep],
    detector: CloudDetector,
    *,
    reading: CloudReading | None = None,
    at_us: Collection[int] | None = None,
    sensor: Sensor | None = None,
    yaw_rad: float | None = None,
) -> Iterator[SweepDetections]:
    """Detect boxes in every sweep as it arrives, fused with the sweeps before it.

    The boxes are bit-identical to ``fcos-lidar detect --sweeps`` with the same sweeps. A sweep without usable
    points has no boxes, whatever the sweeps before it.

    Args:
        sweeps: sweeps in temporal order; may be an iterator that waits for the next sweep.
        reading: number of sweeps to fuse and points to drop; by default as in training. Use one sweep if the poses
            are unknown.
        at_us: times of the sweeps to detect in; other sweeps are only fused into later ones. By default all.
        sensor: sensor that recorded the sweeps, by default the detector's. Sweeps of other sensors are rotated and
            shifted.
        yaw_rad: rotation of the sweeps about z before detection, undone for the boxes, instead of the angle
            between the headings: pi / 2 if x points forward in the sweeps and y in the training data. Detection
            degrades for orientations absent from training.

    Raises:
        ValueError: names a sweep that is not later than the sweep before.

    >>> import numpy as np
    >>> from fcos_lidar_jax.data.sweeps import Sweep
    >>> from fcos_lidar_jax.inference import load_detector
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> from fcos_lidar_jax.simulation.frames import make_frame
    >>> sweeps = (Sweep(make_frame(seed, SHORT_RANGE).points, np.eye(4), seed) for seed in range(2))
    >>> [found.sweep.time_us for found in detect_stream(sweeps, load_detector("quickstart"))]
    [0, 1]
    """
    reading, aligned = reading or detector.config.reading, align(detector.sensor, sensor, yaw_rad=yaw_rad)
    window: deque[Sweep] = deque(maxlen=reading.num_sweeps)
    before: Sweep | None = None
    for sweep in sweeps:
        if before is not None and sweep.time_us <= before.time_us:
            raise ValueError(
                f"{sweep.name}: time: got {sweep.time_us} us, expected more than the {before.time_us} us of the "
                f"sweep before, {before.name}"
            )
        if before is None and (line := aligned.describe()):
            tell(line)
        window.appendleft(sweep)
        before = sweep
        if at_us is not None and sweep.time_us not in at_us:
            continue
        points, num_close = fuse_sweeps(window, aligned.data, reading)
        points = aligned.points(points)
        cloud = make_cloud(points, detector.config, sensor=detector.sensor, num_close=num_close)
        tell_truncation(sweep.name, cloud, detector.config)
        detections = detector.detect(cloud)
        line = no_usable_points(sweep.name, cloud, int(detections.num_dropped), detector.sensor)
        if line is None and cloud.points[cloud.valid, 4].min() > 0:
            line = f"{sweep.name}: only older sweeps have usable points"
        if line is not None:
            detections = dataclasses.replace(detections, valid=np.zeros_like(detections.valid))
        yield SweepDetections(sweep, cloud, aligned.back(detections), line)
