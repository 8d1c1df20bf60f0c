"""Small recordings of ROS 1, ROS 2 and MCAP, written by rosbags' own writers."""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FORMS = ("ros1", "sqlite", "mcap", "mcap file")
CLOUD, TRANSFORMS = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

Recorded = tuple[str, Any]
"""A topic and a message."""


@functools.cache
def _store(is_ros1: bool):
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return store


class Messages:
    """Messages of ROS 1 or ROS 2. Poses are a translation and a quaternion x, y, z, w."""

    def __init__(self, is_ros1: bool) -> None:
        self._is_ros1 = is_ros1

    def make(self, kind: str, *fields: object, **named: object) -> Any:
        return _store(self._is_ros1).types[kind.replace("/", "/msg/")](*fields, **named)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/Header", *([0] if self._is_ros1 else []), stamp, frame)

    def cloud(self, stamp_ns: int, points: np.ndarray, frame: str = "lidar", **changed: object) -> Any:
        """Points: a structured array [width] or [height, width]."""
        rows, dtype = np.atleast_2d(points), points.dtype
        fields = [
            self.make("sensor_msgs/PointField", name, place, _DATATYPES[kind.str[1:]], 1)
            for name, (kind, place) in ((name, dtype.fields[name][:2]) for name in dtype.names)
        ]
        big = any(dtype[name].str[0] == ">" for name in dtype.names)
        data, step = np.frombuffer(rows.tobytes(), np.uint8), dtype.itemsize
        values = {"height": rows.shape[0], "width": rows.shape[1], "fields": fields, "is_bigendian": big}
        values |= {"point_step": step, "row_step": step * rows.shape[1], "data": data, "is_dense": True}
        return self.make("sensor_msgs/PointCloud2", self.header(stamp_ns, frame), **(values | changed))

    def _pose(self, place: Iterable[float], turn: Iterable[float]) -> Any:
        point = self.make("geometry_msgs/Point", *map(float, place))
        return self.make("geometry_msgs/Pose", point, self.make("geometry_msgs/Quaternion", *map(float, turn)))

    def pose_stamped(self, stamp_ns: int, place: Iterable[float], turn: Iterable[float]) -> Any:
        return self.make("geometry_msgs/PoseStamped", self.header(stamp_ns, "odom"), self._pose(place, turn))

    def pose_with_covariance(self, stamp_ns: int, place: Iterable[float], turn: Iterable[float]) -> Any:
        pose = self.make("geometry_msgs/PoseWithCovariance", self._pose(place, turn), np.zeros(36))
        return self.make("geometry_msgs/PoseWithCovarianceStamped", self.header(stamp_ns, "odom"), pose)

    def odometry(
        self, stamp_ns: int, place: Iterable[float], turn: Iterable[float], child: str = "base_link"
    ) -> Any:
        pose = self.make("geometry_msgs/PoseWithCovariance", self._pose(place, turn), np.zeros(36))
        zero = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/Twist", zero, zero)
        twist = self.make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36))
        return self.make("nav_msgs/Odometry", self.header(stamp_ns, "odom"), child, pose, twist)

    def transform(
        self, stamp_ns: int, parent: str, child: str, place: Iterable[float], turn: Iterable[float]
    ) -> Any:
        """A message with one transform."""
        vector = self.make("geometry_msgs/Vector3", *map(float, place))
        quaternion = self.make("geometry_msgs/Quaternion", *map(float, turn))
        transform = self.make("geometry_msgs/Transform", vector, quaternion)
        stamped = self.make("geometry_msgs/TransformStamped", self.header(stamp_ns, parent), child, transform)
        return self.make("tf2_msgs/TFMessage", [stamped])

    def text(self, words: str) -> Any:
        return self.make("std_msgs/String", words)


def write_recording(
    place: Path, form: str, content: Callable[[Messages], Iterable[Recorded]], *, compression: str = ""
) -> Path:
    """Write a recording in one of the :data:`FORMS`, with a microsecond between messages; returns its path.

    ``compression`` is ``LZ4`` or ``BZ2`` for ROS 1. For ROS 2 it names what zstd compresses: ``FILE``, ``MESSAGE``
    or, in MCAP, ``STORAGE``.
    """
    is_ros1 = form == "ros1"
    store = _store(is_ros1)
    if is_ros1:
        place = place.with_suffix(".bag")
        writer: Any = rosbag1.Writer(place)
    else:
        plugin = "SQLITE3" if form == "sqlite" else "MCAP"
        writer = rosbag2.Writer(place, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    if compression and is_ros1:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    elif compression:
        writer.set_compression(rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for number, (topic, message) in enumerate(content(Messages(is_ros1))):
            kind = message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=store)
            raw = store.serialize_ros1(message, kind) if is_ros1 else store.serialize_cdr(message, kind)
            writer.write(connections[topic, kind], 10**18 + number * 1000, raw)
    return next(place.glob("*.mcap")) if form == "mcap file" else place


def structured(points: np.ndarray, names: tuple[str, ...] = ("x", "y", "z", "intensity")) -> np.ndarray:
    """Convert columns of an array to a structured array."""
    return np.rec.fromarrays(list(points.T[: len(names)]), names=list(names))
