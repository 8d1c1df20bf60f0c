"""Recordings of ROS 1, ROS 2 and MCAP: the clouds of a topic, with poses from odometry or transforms.

Messages are read with the definitions of rosbags. Definitions in a recording are ignored, since rosbags would
translate them into Python code.
"""

import contextlib
import functools
import heapq
import itertools
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.drives import Drive, OutsidePosesError, PoseRow, PoseTrack, make_track, read_tum
from fcos_lidar_jax.data.frame import no_points
from fcos_lidar_jax.data.frame_tree import FrameTree
from fcos_lidar_jax.data.pcd import find_columns
from fcos_lidar_jax.data.point_files import ENDINGS, MAX_POINTS, assemble_points
from fcos_lidar_jax.data.sweeps import Sweep
from fcos_lidar_jax.fields import printable
from fcos_lidar_jax.files import import_extra, refusing
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor

_CLOUD = ("sensor_msgs/msg/PointCloud2",)
_POSE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
BAG_ENDINGS = (".bag", ".mcap", ".db3")
_LISTS = "relative_file_paths"  # in the metadata of a recording
_MAX_LISTED = 20  # topics listed in a message
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Datatype of a field -> NumPy's type."""

_PoseAt = Callable[[str, int, str], np.ndarray]
"""(frame of a cloud, microseconds, name of the cloud for messages) -> sensor to world, f64[4, 4]."""


def is_ros_bag(path: Path) -> bool:
    """Whether a path is a recording: ``.bag``, ``.mcap``, ``.db3``, or a folder of them or with their metadata."""
    if path.suffix in BAG_ENDINGS or not path.is_dir():
        return path.suffix in BAG_ENDINGS
    if _LISTS in (_metadata(path) or ""):
        return True
    files = [*path.iterdir()]
    points = any(file.name.lower().endswith(ENDINGS) for file in files)
    return not points and any(file.suffix in BAG_ENDINGS for file in files)


def _files(path: Path) -> list[Path]:
    """What rosbags can open: the path, or the files of a folder whose metadata lack the format or are missing."""
    if not path.is_dir():
        return [path]
    text = _metadata(path)
    if text is not None and (_LISTS not in text or re.search(r"storage_identifier:\s*[\"']?\w", text)):
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix in BAG_ENDINGS) or [path]


def _metadata(folder: Path) -> str | None:
    """The metadata of a recording in a folder; other tools write files of this name as well."""
    file = folder / "metadata.yaml"
    return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None


def ros_bag_drive(
    path: Path,
    sensor: Sensor,
    *,
    topic: str | None = None,
    odometry: str | None = None,
    poses: Path | None = None,
    max_points: int = MAX_POINTS,
) -> Drive:
    """The clouds of a recording, in the order of recording; needs the extra ``ros``.

    Times of sweeps and poses are their headers' stamps, rounded down to microseconds. Poses are interpolated by
    :class:`~fcos_lidar_jax.data.drives.PoseTrack`. Sweeps are not corrected for motion of the ego vehicle within
    them. Clouds before the first or after the last pose are skipped, with a note in the drive.

    Args:
        topic: topic of the clouds (``PointCloud2``); may be omitted if there is only one.
        odometry: topic of ``Odometry``, ``PoseStamped`` or ``PoseWithCovarianceStamped``; or ``"tf"``: the
            transforms from the cloud's frame up to ``odom``, or to the root. If the child frame of the odometry
            is not the cloud's frame, the transforms between the two complete it.
        poses: instead of odometry, a file for :func:`~fcos_lidar_jax.data.drives.read_tum` of the cloud's frame.
    """
    with _Bag(path) as bag:
        clouds = bag.choose(topic, _CLOUD, "topic")
        pose_at, notes = _poses(bag, odometry, poses)

    def read() -> Iterator[Sweep]:
        number, outside, first = 0, list[OutsidePosesError](), None
        try:
            with _Bag(path) as bag:
                for where, cloud in bag.messages(clouds, _CLOUD):
                    number, time_us, frame = number + 1, _time_us(cloud.header), _frame(cloud.header.frame_id)
                    first = frame if first is None else first
                    if frame != first:
                        ids = f"frame_id {printable(frame)!r} after {printable(first)!r}"
                        tell(f"note: {where}: {ids}: clouds of several sensors?", once="frame_id")
                    try:
                        pose = np.eye(4) if pose_at is None else pose_at(frame, time_us, where)
                    except OutsidePosesError as error:
                        outside.append(error)
                        continue
                    points = _parse_cloud(cloud, where, sensor, max_points=max_points)
                    yield Sweep(points, pose, time_us, where)
        finally:
            if 0 < len(outside) < number:
                notes.append(f"{len(outside)} clouds before the first or after the last pose were skipped")
        if number == 0:
            raise ValueError(f"{path}: {printable(clouds)}: no cloud in it, expected at least one")
        if len(outside) == number:
            raise outside[0]

    return Drive(read(), posed=pose_at is not None, notes=notes)


class _Bag(contextlib.AbstractContextManager):
    """An open recording; exceptions about damaged content become one-line errors."""

    def __init__(self, path: Path) -> None:
        import_extra("rosbags", "ros", f"{path}: ")
        from rosbags import rosbag1, rosbag2

        with refusing(f"{path}: cannot be read"), contextlib.ExitStack() as opened:
            self.path, parts = path, _files(path)
            self._is_ros1 = parts[0].suffix == ".bag"
            kind: Any = rosbag1 if self._is_ros1 else rosbag2
            self._readers = [opened.enter_context(kind.Reader(part)) for part in parts]
            self.counts = defaultdict[tuple[str, str], int](int)  # (topic, type) -> messages
            for one in itertools.chain.from_iterable(reader.connections for reader in self._readers):
                self.counts[str(one.topic), str(one.msgtype)] += int(one.msgcount)
            self._opened = opened.pop_all()

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(Exception):
            self._opened.close()

    def topics(self, types: tuple[str, ...]) -> list[str]:
        return sorted({topic for topic, kind in self.counts if kind in types})

    def choose(self, name: str | None, types: tuple[str, ...], option: str) -> str:
        """Check that the named topic has one of the types; without a name, the only topic that has."""
        fitting = self.topics(types)
        if name is not None and name in fitting:
            return name
        if name is None and len(fitting) == 1:
            return fitting[0]
        names = " or ".join(kind.rpartition("/")[2] for kind in types)
        listed = [
            f"{printable(topic)} ({printable(kind)}, {count} messages)"
            for (topic, kind), count in sorted(self.counts.items())
            if not fitting or kind in types
        ]
        more = ["..."] if len(listed) > _MAX_LISTED else []
        topics = ", ".join(listed[:_MAX_LISTED] + more) or "none"
        found = f"{len(fitting)} topics and no name" if name is None else repr(name)
        raise ValueError(f"{self.path}: {option}: got {found}, expected a topic of {names} among: {topics}")

    def messages(self, topic: str, types: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        sources, number = [], 0
        for reader in self._readers:
            if wanted := [one for one in reader.connections if one.topic == topic and one.msgtype in types]:
                sources.append(reader.messages(connections=wanted))
        raw = heapq.merge(*sources, key=lambda record: record[1])  # by time of recording
        while True:
            where = f"{self.path}: {printable(topic)}: message {number}"
            with refusing(f"{where}: cannot be read"):
                if (record := next(raw, None)) is None:
                    return
                connection, _, content = record
                store = _typestore(self._is_ros1)
                read = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
                message = read(content, connection.msgtype)
            yield where, message
            number += 1


@functools.cache
def _typestore(is_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not is_ros1:
        return get_typestore(Stores.LATEST)
    types = get_typestore(Stores.ROS1_NOETIC)
    for kind in _TRANSFORMS:  # missing in rosbags
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return types


def _frame(name: str) -> str:
    return name.removeprefix("/")  # ROS 1 writes names with and without the slash


def _time_us(header: Any) -> int:
    return header.stamp.sec * 1_000_000 + header.stamp.nanosec // 1000


def _poses(bag: _Bag, odometry: str | None, poses: Path | None) -> tuple[_PoseAt | None, list[str]]:
    """The sensor's poses, None without odometry and poses, and notes about assumptions."""
    if poses is not None:
        track = read_tum(poses)
        return lambda frame, time_us, where: track.at(time_us, f"{poses}: {where}"), []
    if odometry is None:
        return None, []
    if odometry == "tf":
        if not bag.topics(_TRANSFORMS):
            bag.choose("tf", _TRANSFORMS, "odometry")
        return _read_transforms(bag).to_world, []
    odometry = bag.choose(odometry, _POSE, "odometry")
    track, child = _read_odometry(bag, odometry)
    name, tree = printable(odometry), _read_transforms(bag)

    def to_world(frame: str, time_us: int, where: str) -> np.ndarray:
        pose = track.at(time_us, f"{where}: {name}")
        return pose @ tree.between(child, frame, time_us, where) if child else pose

    assumed = f"{name} does not name the frame of its poses: assumed to be the clouds' frame"
    return to_world, [] if child else [assumed]


def _read_odometry(bag: _Bag, topic: str) -> tuple[PoseTrack, str]:
    """Poses of a topic and their frame, "" if the messages do not name it."""
    rows, times, child = [], [], None
    for where, message in bag.messages(topic, _POSE):
        frame = _frame(getattr(message, "child_frame_id", ""))
        child = frame if child is None else child
        if frame != child:
            got, expected = printable(frame), printable(child)
            raise ValueError(f"{where}: child_frame_id: got {got!r}, expected {expected!r} as before")
        pose = getattr(message.pose, "pose", message.pose)  # poses with covariance are nested
        rows.append(_numbers(pose.orientation, pose.position))
        times.append(_time_us(message.header))
    place = f"{bag.path}: {printable(topic)}: message"
    return make_track(times, rows, lambda row: f"{place} {row}"), child or ""


def _read_transforms(bag: _Bag) -> FrameTree:
    tree = FrameTree(str(bag.path))
    for topic in bag.topics(_TRANSFORMS):
        for _, message in bag.messages(topic, _TRANSFORMS):
            for each in message.transforms:
                time_us = None if topic.endswith("tf_static") else _time_us(each.header)
                pose = _numbers(each.transform.rotation, each.transform.translation)
                tree.add(_frame(each.child_frame_id), _frame(each.header.frame_id), time_us, pose)
    return tree


def _numbers(rotation: Any, translation: Any) -> PoseRow:
    return rotation.w, rotation.x, rotation.y, rotation.z, translation.x, translation.y, translation.z


def _parse_cloud(cloud: Any, where: str, sensor: Sensor, *, max_points: int) -> np.ndarray:
    """The points of a PointCloud2 message, in the columns of :func:`~fcos_lidar_jax.data.point_files.read_points`.

    ``cloud`` has the message's fields, with ``data`` u8[n]. Clouds of more than ``max_points`` are refused before
    they take memory. ``where`` names the message in errors.
    """
    width, height, step, pitch = cloud.width, cloud.height, cloud.point_step, cloud.row_step
    if width * height > max_points:
        raise ValueError(f"{where}: got {width} x {height} points, expected at most {max_points}")
    if height <= 1 or len(cloud.data) == height * width * step:  # some drivers leave it 0, or count points
        pitch = width * step
    if not width * height:
        return no_points(sensor)
    if pitch < width * step or len(cloud.data) < (height - 1) * pitch + width * step:
        found = f"{len(cloud.data)} bytes, and row_step {pitch}"
        raise ValueError(f"{where}: data: got {found}, expected {height} rows of {width} points of {step} bytes")
    columns = {}
    for column, dtype, offset in _columns_of(cloud, where):
        values = np.ndarray((height, width), dtype, cloud.data.data, offset, (pitch, step))
        columns[column] = values.reshape(-1)
    return assemble_points(where, sensor, columns)


def _columns_of(cloud: Any, where: str) -> list[tuple[str, np.dtype, int]]:
    """The message's columns, with type and offset within a point."""
    columns, names = [], [field.name for field in cloud.fields]
    places = find_columns(names, where)
    if missing := [axis for axis in "xyz" if axis not in places]:
        listed = ", ".join(map(repr, names))[:500] or "none"
        raise ValueError(f"{where}: fields: got {listed}, expected one named {missing[0]}")
    places.pop("time_lag", None)  # messages hold single sweeps
    for column, place in places.items():
        field, end = cloud.fields[place], 0
        if field.datatype in _NUMBERS and field.count <= 1:
            dtype = np.dtype((">" if cloud.is_bigendian else "<") + _NUMBERS[field.datatype])
            columns.append((column, dtype, field.offset))
            end = field.offset + dtype.itemsize
        if not 0 < end <= cloud.point_step:
            got = f"{field.count} of datatype {field.datatype} at offset {field.offset}"
            expected = f"one number of datatype 1 to 8 within the {cloud.point_step} bytes of a point"
            raise ValueError(f"{where}: field {names[place]}: got {got}, expected {expected}")
    return columns
