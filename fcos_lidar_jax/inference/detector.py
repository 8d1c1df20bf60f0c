"""Trained detectors: a network with its weights."""

import abc
import dataclasses
import functools
import hashlib
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.cloud_policy import Cloud, sensor_mismatch, truncation
from fcos_lidar_jax.data.clouds import read_cloud
from fcos_lidar_jax.data.frame import drop_close, unlabelled
from fcos_lidar_jax.data.point_files import points_from_array
from fcos_lidar_jax.devices.mesh import make_mesh, replicate, shard_batch
from fcos_lidar_jax.evaluation.records import confident, point_counts
from fcos_lidar_jax.inference.alignment import align
from fcos_lidar_jax.inference.detect import make_detect, over_clouds
from fcos_lidar_jax.inference.detected_boxes import DetectedBoxes
from fcos_lidar_jax.inference.loop import Request, detect_clouds
from fcos_lidar_jax.models import Detector, Variables, build_detector
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.refinement import without_second_look
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.types import Detections

Rows = np.ndarray | jax.Array | Sequence[Any]


@dataclasses.dataclass(frozen=True, repr=False, eq=False)  # equality of weights would be slow
class CloudDetector(abc.ABC):
    """A detector from a checkpoint or an exported file, which maps point clouds to boxes."""

    model: Detector  # functions of the network, with its configuration and sensor

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.config.name!r}, {self.sensor.name!r}, classes={self.classes!r})"

    @property
    def config(self) -> Config:
        return self.model.config

    @property
    def sensor(self) -> Sensor:
        return self.model.sensor

    @property
    def classes(self) -> tuple[str, ...]:
        return self.config.classes

    @property
    @abc.abstractmethod
    def fingerprint(self) -> str:
        """Fingerprint of the weights and, in an exported file, of the program."""

    @abc.abstractmethod
    def program(self, mesh: Mesh, batch_size: int = 1) -> Callable[..., Any]:
        """Detection in ``batch_size`` clouds per device.

        With a batch size of 1, every device runs the program for a single cloud, so the boxes do not depend on the
        number of devices.

        Returns:
            compiled ``(points f32[b, n, c], valid bool[b, n]) -> Detections`` with a leading axis b,
            ``batch_size`` times the number of devices, split over the devices.
        """

    def __call__(
        self,
        points: Rows | str | Path,
        *,
        sensor: Sensor | str | Path | None = None,
        full_turn: bool = False,
    ) -> DetectedBoxes:
        """Detect boxes in one cloud of any length; compiled once.

        Warns in one line if the cloud does not fit the sensor of the detector, or has no usable points.

        Args:
            points: a point file, see :func:`~fcos_lidar_jax.data.point_files.read_points`; or [n, 3 to 6]: x, y, z
                in metres, intensity, time lag in seconds, laser number (from the highest laser down), as in an
                array file. The sensor scales intensities unless most of them, without zeros, would exceed 255, as
                in points of frames, which are already scaled. Under ``jax.jit``, call the function of
                :func:`~fcos_lidar_jax.inference.make_detect` instead.
            sensor: sensor that recorded the points, or its name or JSON file; gives their heading, position and
                intensity scale. By default the detector's or, for files in the folders of KITTI, Argoverse 2 and
                own data with ``sensor.json``, theirs.
            full_turn: keep the points of KITTI's files outside the camera image, see
                :func:`~fcos_lidar_jax.data.kitti.in_camera`.

        Returns:
            the boxes, best score first, at most ``config.inference.max_detections``, without padding.

        Raises:
            ValueError: invalid shape or type, or a fifth column of something other than time lags.
        """
        is_file = isinstance(points, str | Path)
        sensor = load_sensor(sensor) if isinstance(sensor, str | Path) else sensor
        paths = [Path(points)] if is_file else []
        aligned = align(self.sensor, sensor, paths=paths)
        data, reading = aligned.data, self.config.reading
        if is_file:
            rows, num_close = read_cloud(points, data, reading, full_turn=full_turn)
        else:
            rows, num_close = drop_close(_scaled_once(points, data, reading.num_sweeps), data, reading)
        aligned.tell_notes()
        request = Request(0, str(points) if is_file else "points", lambda: unlabelled(rows, num_close))
        how: dict[str, Any] = {"devices": jax.local_devices()[:1], "ahead": 0, "quiet": True}
        [prediction] = detect_clouds(self.program, self.config, aligned, [request], **how)
        found, cloud = prediction.detections, prediction.cloud
        assert cloud is not None
        mismatch = sensor_mismatch(aligned.points(rows), self.sensor)
        for line in filter(None, (mismatch, truncation(cloud.num_truncated, self.config), prediction.note)):
            warnings.warn(line, stacklevel=2)
        boxes, labels, scores = confident(found, 0.0)
        counts = ({"file": str(points)} if is_file else {}) | point_counts(found, cloud)
        used = aligned.inverse.points(cloud.points[cloud.valid])
        return DetectedBoxes(boxes, scores, labels, self.classes, used, counts, self.sensor.limit_xy_m)

    def detect(self, cloud: Cloud) -> Detections:
        """Detect boxes in a cloud from :func:`~fcos_lidar_jax.data.cloud_policy.make_cloud`, as NumPy arrays.

        Padded to ``config.inference.max_detections`` boxes; ``valid`` is False for padding.
        """
        mesh = make_mesh(jax.local_devices()[:1])
        found = self.program(mesh)(*shard_batch((cloud.points[None], cloud.valid[None]), mesh))
        return jax.tree.map(lambda leaf: leaf[0], jax.device_get(found))


def _scaled_once(points: Rows, sensor: Sensor, num_sweeps: int) -> np.ndarray:
    """An array in the columns of a sensor; its intensities are scaled unless they were before."""
    rows = points_from_array(points, sensor, num_sweeps=num_sweeps)
    if sensor.intensity_scale == 1:
        return rows
    if np.count_nonzero(rows[:, 3] > 255) > np.count_nonzero(rows[:, 3] > 0) / 2:
        seem = "most would exceed 255: they seem to be scaled already"
        tell(f"note: intensities are not scaled, since of those above 0 {seem}", once=True)
        return points_from_array(points, dataclasses.replace(sensor, intensity_scale=1.0))
    return rows


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class TrainedDetector(CloudDetector):
    """A network with its weights."""

    variables: Variables  # ``params`` and ``batch_stats``
    _placed: dict[Mesh, Any] = dataclasses.field(default_factory=dict, init=False, repr=False, compare=False)
    """Variables on the devices of each mesh, because a transfer for every cloud would be slow."""

    @property
    def fingerprint(self) -> str:
        digest = hashlib.blake2b(digest_size=16)
        for leaf in jax.tree.leaves(self.variables):
            digest.update(np.ascontiguousarray(leaf).data)
        return digest.hexdigest()

    def with_inference(self, **fields: Any) -> "TrainedDetector":
        """Change the post-processing, on which training does not depend.

        Args:
            fields: fields of :class:`~fcos_lidar_jax.config.InferenceConfig` to change.

        Raises:
            ValueError: an invalid value, or flips that were not used in training.
        """
        inference = dataclasses.replace(self.config.inference, **fields)
        config = dataclasses.replace(self.config, inference=inference)
        return dataclasses.replace(self, model=build_detector(config, self.sensor))

    def without_second_look(self) -> "TrainedDetector":
        """Remove the second look: the result has the boxes and scores of the detector itself."""
        model = build_detector(dataclasses.replace(self.config, refinement=None), self.sensor)
        return dataclasses.replace(self, model=model, variables=without_second_look(self.variables))

    def program(self, mesh: Mesh, batch_size: int = 1) -> Callable[..., Any]:
        if mesh not in self._placed:
            self._placed[mesh] = replicate(self.variables, mesh)
        return functools.partial(_split_detect(self.model, mesh, batch_size), self._placed[mesh])


@functools.lru_cache(maxsize=8)
def _split_detect(detector: Detector, mesh: Mesh, batch_size: int) -> Callable[..., Any]:
    return jit_split(over_clouds(make_detect(detector), batch_size), mesh, shared=1)


def jit_split(on_one_device: Callable[..., Any], mesh: Mesh, *, shared: int = 0) -> Callable[..., Any]:
    """Compile a function that every device runs on its rows of the last two arguments, after ``shared`` others."""
    rows = PartitionSpec(mesh.axis_names[0])
    specs = {"in_specs": (*[PartitionSpec()] * shared, rows, rows), "out_specs": rows}
    return jax.jit(jax.shard_map(on_one_device, mesh=mesh, **specs, check_vma=False))
