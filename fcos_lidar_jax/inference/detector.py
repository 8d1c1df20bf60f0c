"""A trained detector: weights with the network that they are for."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.point_files import points_from_array
from fcos_lidar_jax.inference.cloud import Cloud, make_cloud
from fcos_lidar_jax.inference.detect import make_detect
from fcos_lidar_jax.models import Detector, Variables, build_detector
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.training.checkpoint import load_checkpoint
from fcos_lidar_jax.training.checkpoints import find_checkpoint
from fcos_lidar_jax.training.sharding import make_mesh, replicate, shard_batch
from fcos_lidar_jax.types import Detections


@dataclasses.dataclass(frozen=True)
class TrainedDetector:
    """A network with its weights, its configuration, and the sensor whose clouds it was trained on.

    >>> from fcos_lidar_jax.inference import load_detector
    >>> detector = load_detector("quickstart")
    >>> detector.sensor.name, len(detector.classes)
    ('short_range', 10)
    """

    model: Detector
    variables: Variables  # ``params`` and ``batch_stats``.

    @property
    def config(self) -> Config:
        return self.model.config

    @property
    def sensor(self) -> Sensor:
        return self.model.sensor

    @property
    def classes(self) -> tuple[str, ...]:
        return self.config.classes

    def __call__(self, points: np.ndarray) -> Detections:
        """Boxes in one cloud of any length; compiled once.

        Args:
            points: [n, 3 to 6], x, y, z in metres, intensity, time lag in seconds, laser number, as
                :func:`~fcos_lidar_jax.data.point_files.read_points` takes them from an array file.

        Returns:
            NumPy arrays, padded to ``config.inference.max_detections`` boxes.

        Raises:
            ValueError: another shape or type, or a fifth column that is a ring and no time lag.
        """
        return self.detect(make_cloud(points_from_array(points, self.sensor), self.config, sensor=self.sensor))

    def detect(self, cloud: Cloud) -> Detections:
        """Boxes in one cloud of :func:`~fcos_lidar_jax.inference.cloud.make_cloud`, as NumPy arrays."""
        mesh = make_mesh(jax.local_devices()[:1])
        found = sharded_detect(self.model, mesh)(
            replicate(self.variables, mesh), *shard_batch((cloud.points[None], cloud.valid[None]), mesh)
        )
        return jax.tree.map(lambda leaf: leaf[0], jax.device_get(found))


def load_detector(checkpoint: str | Path) -> TrainedDetector:
    """A detector from a checkpoint, a run, or weights that come with the package, see :func:`find_checkpoint`.

    Raises:
        CheckpointError: naming the folder, what was found and what was expected.
    """
    read = load_checkpoint(find_checkpoint(Path(checkpoint)))
    return TrainedDetector(build_detector(read.config, read.sensor), read.variables)


@functools.lru_cache(maxsize=8)
def sharded_detect(detector: Detector, mesh: Mesh, batch_size: int = 1) -> Callable[..., Any]:
    """Detection of many clouds, each device working on its own.

    With one cloud a device every device runs the program of a single cloud, so the boxes do not depend on the
    number of devices.

    Returns:
        compiled ``(variables, points f32[b, n, c], valid bool[b, n]) -> Detections`` with a leading axis b,
        ``batch_size`` times the number of devices, split over the devices.
    """
    detect = make_detect(detector)
    if batch_size > 1:
        detect = jax.vmap(detect, (None, 0, 0))

    def on_one_device(variables: Variables, points: jax.Array, valid: jax.Array) -> Any:
        if batch_size > 1:
            return detect(variables, points, valid)
        return jax.tree.map(lambda leaf: leaf[None], detect(variables, points[0], valid[0]))

    rows = PartitionSpec(mesh.axis_names[0])
    specs = {"in_specs": (PartitionSpec(), rows, rows), "out_specs": rows}
    return jax.jit(jax.shard_map(on_one_device, mesh=mesh, **specs, check_vma=False))
