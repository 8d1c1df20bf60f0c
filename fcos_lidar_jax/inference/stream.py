"""Boxes in a drive, sweep by sweep: a rolling window of sweeps on the host, one compiled program."""

import dataclasses
from collections import deque
from collections.abc import Collection, Iterable, Iterator

import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.cloud_policy import Cloud, expect_points, make_cloud
from fcos_lidar_jax.data.sweeps import Sweep, about_z, fuse_sweeps, sensor_before_rotation, turned
from fcos_lidar_jax.inference.detector import CloudDetector
from fcos_lidar_jax.inference.tracks import to_world
from fcos_lidar_jax.types import Detections


@dataclasses.dataclass(frozen=True)
class Found:
    """What was found in one sweep and those before it."""

    sweep: Sweep  # The current one, as it was given.
    cloud: Cloud  # What the network was given: the window's sweeps in the frame of the current one, turned.
    detections: Detections  # NumPy arrays, in the frame of the sweep.


def detect_stream(
    sweeps: Iterable[Sweep],
    detector: CloudDetector,
    *,
    reading: CloudReading | None = None,
    at_us: Collection[int] | None = None,
    yaw_rad: float = 0.0,
) -> Iterator[Found]:
    """Boxes in every sweep as it comes, with the sweeps before it fused into its frame.

    The boxes are bit-identical to those of ``fcos-lidar detect --sweeps`` with the same sweeps.

    Args:
        sweeps: in the order of time; an iterator that waits for the next sweep will do.
        detector: compiled once, for the first sweep.
        reading: sweeps to fuse and points to drop; default: as the detector was trained. One sweep where poses are
            not known.
        at_us: times of the sweeps to detect in; the others are only fused into later ones. Default: all.
        yaw_rad: by which sweeps are turned about z for the detector, and boxes back: pi / 2 for a sensor whose x
            axis points ahead and a detector of one whose y axis does. A detector finds less in clouds that are
            turned as its training's never were.

    Raises:
        ValueError: naming the sweep: its time is not after that of the one before, or no point of it is usable.

    >>> import numpy as np
    >>> from fcos_lidar_jax.inference import load_detector
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> from fcos_lidar_jax.simulation.frames import make_frame
    >>> sweeps = (Sweep(make_frame(seed, SHORT_RANGE).points, np.eye(4), seed) for seed in range(2))
    >>> [found.sweep.time_us for found in detect_stream(sweeps, load_detector("quickstart"))]
    [0, 1]
    """
    reading, sensor = reading or detector.config.reading, detector.sensor
    window: deque[Sweep] = deque(maxlen=reading.num_sweeps)
    before: Sweep | None = None
    turn, unturned = about_z(yaw_rad), sensor_before_rotation(sensor, yaw_rad)
    for sweep in sweeps:
        if before is not None and sweep.time_us <= before.time_us:
            raise ValueError(
                f"{sweep.name}: time: got {sweep.time_us} us, expected more than the {before.time_us} us of the "
                f"sweep before, {before.name}"
            )
        window.appendleft(sweep)
        before = sweep
        if at_us is not None and sweep.time_us not in at_us:
            continue
        points, num_close = fuse_sweeps(window, unturned, reading)
        if yaw_rad:
            points = turned(points, turn)
        cloud = make_cloud(points, detector.config, sensor=sensor, num_close=num_close)
        found = detector.detect(cloud)
        expect_points(sweep.name, cloud, int(found.num_dropped), sensor)
        if yaw_rad:
            found = dataclasses.replace(found, boxes=to_world(np.asarray(found.boxes), turn.T).astype(np.float32))
        yield Found(sweep, cloud, found)
