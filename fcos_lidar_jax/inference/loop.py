"""The loop of all detection: read clouds ahead, align them, detect, and transform the boxes back."""

import contextlib
import dataclasses
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.cloud_policy import Cloud, make_cloud, no_usable_points, tell_truncation
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.sweeps import Sweep
from fcos_lidar_jax.devices.agreement import agreed
from fcos_lidar_jax.devices.mesh import make_mesh, shard_batch
from fcos_lidar_jax.inference.alignment import Alignment
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.types import Detections

_Loaded = dict[int, tuple[Frame, Cloud]]  # by row of the batch, without rows that other processes read


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Detections in one frame."""

    index: int  # index of the frame
    detections: Detections  # NumPy arrays, in the frame of the data
    frame: Frame | None  # the frame; None if another process has read it
    cloud: Cloud | None  # input of the network, with counts of dropped points; None if another process has read it
    note: str | None = None  # a line if the cloud has no usable points; None if another process has read it
    sweep: Sweep | None = None  # in a drive: the current sweep, unchanged


@dataclasses.dataclass(frozen=True)
class Request:
    """A cloud to detect in."""

    index: int
    name: str  # in messages
    read: Callable[[], Frame]
    sweep: Sweep | None = None


def detect_clouds(
    program: Callable[..., Callable[..., Any]],
    config: Config,
    aligned: Alignment,
    requests: Iterable[Request],
    *,
    batch_size: int = 1,
    devices: Sequence[Any] | None = None,
    ahead: int = 2,
    quiet: bool = False,
) -> Iterator[Prediction]:
    """Detect in clouds, in order; the devices process groups of ``batch_size`` clouds each.

    Args:
        program: see :meth:`~fcos_lidar_jax.inference.CloudDetector.program`.
        requests: may wait for its next cloud.
        devices: by default all, including those of other processes, which make the same call. If one of them
            cannot read its frames, an OSError says so.
        ahead: groups to read ahead. With 0, predictions are returned before the next cloud is requested.
        quiet: print nothing.
    """
    mesh = make_mesh(devices)
    batches = _Batches(config, aligned, [device for device in mesh.devices.flat for _ in range(batch_size)], quiet)
    compiled, source, told = program(mesh, batch_size), iter(requests), quiet
    reading = deque[tuple[list[Request], Future[Any]]]()
    running = deque[tuple[list[Request], _Loaded, Any]]()
    with ThreadPoolExecutor(max(ahead, 1)) as pool:
        while True:
            while len(reading) <= ahead and (group := list(itertools.islice(source, len(batches.devices)))):
                reading.append((group, pool.submit(batches.read, group)))
            if not reading:
                break
            group, future = reading.popleft()
            with agreed("cannot read its frames") if batches.several else contextlib.nullcontext():
                loaded, clouds = future.result()
            if not told and (first := next((f for f, _ in loaded.values() if len(f.points)), None)):
                aligned.announce(aligned.points(first.points))  # once it was read: an error would make this moot
                told = True
            if not quiet:
                tell("compiling the detector: up to a minute on a CPU", once=True)
            running.append((group, loaded, compiled(*shard_batch(clouds, mesh))))
            while len(running) > bool(ahead):
                yield from batches.collect(*running.popleft())
        for batch in running:
            yield from batches.collect(*batch)


class _Batches:
    """Batches of clouds, of which this process reads the rows of its devices."""

    def __init__(self, config: Config, aligned: Alignment, devices: list[Any], quiet: bool) -> None:
        self.config, self.aligned, self.devices, self.quiet = config, aligned, devices, quiet  # devices by row
        owners = [device.process_index for device in devices]
        self.own_rows = [row for row, owner in enumerate(owners) if owner == jax.process_index()]
        self.several = len({*owners}) > 1  # processes

    def read(self, group: list[Request]) -> tuple[_Loaded, tuple[np.ndarray, np.ndarray]]:
        shape = (len(self.own_rows), self.config.max_points, self.aligned.detector.point_columns)
        points, valid, loaded = np.zeros(shape, np.float32), np.zeros(shape[:2], bool), {}
        for slot, row in enumerate(self.own_rows):
            if row < len(group):
                frame = group[row].read()
                given, sensor = self.aligned.points(frame.points), self.aligned.detector
                cloud = make_cloud(given, self.config, sensor=sensor, num_close=frame.num_close)
                if not self.quiet:
                    tell_truncation(group[row].name, cloud, self.config)
                points[slot], valid[slot] = cloud.points, cloud.valid
                loaded[row] = frame, cloud
        return loaded, (points, valid)

    def collect(self, group: list[Request], loaded: _Loaded, outputs: Any) -> Iterator[Prediction]:
        if self.several:
            outputs = multihost_utils.process_allgather(outputs, tiled=True)
        arrays = jax.device_get(outputs)
        for row, request in enumerate(group):
            found = self.aligned.back(jax.tree.map(lambda leaf, row=row: leaf[row], arrays))
            frame, cloud = loaded.get(row, (None, None))
            dropped = int(found.num_dropped)
            note = cloud and no_usable_points(request.name, cloud, dropped, self.aligned.detector)
            yield Prediction(request.index, found, frame, cloud, note, request.sweep)
