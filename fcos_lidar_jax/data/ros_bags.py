"""Recordings of ROS 1, ROS 2 and MCAP: the clouds of a topic, with poses of odometry or transforms.

Messages are read with the definitions that rosbags brings along; those that a recording holds, which it would
translate into Python, are left alone.
"""

import contextlib
import functools
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.drives import Drive, OutsidePosesError, PoseTrack, read_tum
from fcos_lidar_jax.data.point_files import MAX_POINTS, assemble_points
from fcos_lidar_jax.data.sweeps import Sweep, find_bad_pose
from fcos_lidar_jax.sensors import Sensor

_CLOUD = ("sensor_msgs/msg/PointCloud2",)
_POSE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_COLUMNS: dict[str, tuple[str, ...]] = {name: (name,) for name in "xyz"}
_COLUMNS["intensity"] = ("intensity", "reflectivity")
_COLUMNS["laser"] = ("ring", "laser_number", "laser", "line", "channel")
"""Column -> the field names it goes by among drivers, the most telling first. Other fields are skipped."""
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Datatype of a field -> NumPy's name."""
_ODOM = "odom"  # the frame that does not jump, by ROS's REP 105; others above it may
_MAX_LISTED = 20  # topics in a message

_PoseAt = Callable[[str, int, str], np.ndarray]
"""(frame of a cloud, microseconds, what to call the cloud) -> sensor to world, f64[4, 4]."""


def is_ros_bag(path: Path) -> bool:
    """Whether a path is a recording: ``.bag``, ``.mcap``, ``.db3``, or a folder with ``metadata.yaml``.

    >>> is_ros_bag(Path("street.bag")), is_ros_bag(Path("street"))
    (True, False)
    """
    return path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


def ros_bag_drive(
    path: Path,
    sensor: Sensor,
    *,
    topic: str | None = None,
    odometry: str | None = None,
    poses: Path | None = None,
    max_points: int = MAX_POINTS,
) -> Drive:
    """The clouds of a recording, in the order in which they were recorded; needs the extra ``ros``.

    The time of a sweep is its header's stamp, rounded down to whole microseconds, as are those of poses. Poses are
    interpolated by the rule of :class:`~fcos_lidar_jax.data.drives.PoseTrack`. Sweeps are not corrected for the
    ego vehicle's motion within them: the times of their points are not read. Clouds before the first and after the
    last pose are left out, which a note of the drive tells.

    Args:
        topic: of the clouds (``PointCloud2``); may be left out where there is one.
        odometry: topic of ``Odometry``, ``PoseStamped`` or ``PoseWithCovarianceStamped``; or ``"tf"``: the
            transforms from the frame of the cloud up to ``odom``, or to the last one. Odometry of another frame
            than the cloud's, as its child frame says, is completed by the transforms between the two.
        poses: instead, a file of lines for :func:`~fcos_lidar_jax.data.drives.read_tum`, of the cloud's frame.
        max_points: a larger cloud is refused.

    Raises:
        ValueError: here or on reading a cloud, naming recording, topic, what was found and what was expected.
    """
    with _Bag(path) as bag:
        topic = bag.choose(topic, _CLOUD, "topic")
        pose_at, notes = _poses(bag, odometry, poses)

    def read() -> Iterator[Sweep]:
        number, outside = 0, list[OutsidePosesError]()
        with _Bag(path) as bag:
            for number, (where, cloud) in enumerate(bag.messages(topic, _CLOUD), 1):
                time_us = _time_us(cloud.header)
                try:
                    pose = np.eye(4) if pose_at is None else pose_at(_frame(cloud.header.frame_id), time_us, where)
                except OutsidePosesError as error:
                    outside.append(error)
                    continue
                yield Sweep(_decode(cloud, where, sensor, max_points), pose, time_us, where)
        if number == 0:
            raise ValueError(f"{path}: {_shown(topic)}: no cloud in it, expected at least one")
        if len(outside) == number:
            raise outside[0]
        if outside:
            notes.append(f"{len(outside)} clouds before the first or after the last pose were left out")

    return Drive(read(), posed=pose_at is not None, notes=notes)


class _Bag(contextlib.AbstractContextManager):
    """An open recording. Whatever the library raises of a damaged one becomes a line."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags import rosbag1, rosbag2
        except ImportError:
            how = "pip install 'fcos-lidar-jax[ros]'"
            raise ValueError(f"{path}: rosbags is not installed, which reads recordings: {how}") from None
        if not path.exists():
            raise ValueError(f"{path}: no such file or folder, expected a recording")
        self.path, self._is_ros1 = path, path.suffix == ".bag"
        files = [path, *path.iterdir()] if path.is_dir() else [path]
        if odd := [file for file in files if file.suffix == ".db3" and set("%?#") & set(str(file))]:
            raise ValueError(f"{_shown(str(odd[0]))}: %, ? or # in the name, which SQLite takes for an address")
        with _refusing(str(path)):
            self._reader: Any = (rosbag1 if self._is_ros1 else rosbag2).Reader(path)
            self._reader.open()
            self.counts = defaultdict[tuple[str, str], int](int)  # (topic, type) -> messages
            for one in self._reader.connections:
                self.counts[str(one.topic), str(one.msgtype)] += int(one.msgcount)

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(Exception):
            self._reader.close()

    def topics(self, types: tuple[str, ...]) -> list[str]:
        return sorted({topic for topic, kind in self.counts if kind in types})

    def choose(self, wanted: str | None, types: tuple[str, ...], what: str) -> str:
        """The topic of these types that is wanted, or the only one."""
        fitting = self.topics(types)
        if wanted in fitting:
            return wanted
        if wanted is None and len(fitting) == 1:
            return fitting[0]
        names = " or ".join(kind.rpartition("/")[2] for kind in types)
        listed = [
            f"{_shown(topic)} ({_shown(kind)}, {count} messages)"
            for (topic, kind), count in sorted(self.counts.items())
            if not fitting or kind in types
        ]
        more = [f"{len(listed) - _MAX_LISTED} more"] if len(listed) > _MAX_LISTED else []
        there = ", ".join(listed[:_MAX_LISTED] + more) or "none"
        found = f"{len(fitting)} of them and none named" if wanted is None else repr(wanted)
        raise ValueError(f"{self.path}: {what}: got {found}, expected a topic of {names}; there are: {there}")

    def messages(self, topic: str, types: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        """What to call each message of a topic, and the message."""
        connections = [one for one in self._reader.connections if one.topic == topic and one.msgtype in types]
        raw, number = self._reader.messages(connections=connections), 0
        while True:
            where = f"{self.path}: {_shown(topic)}: message {number}"
            with _refusing(where):
                if (record := next(raw, None)) is None:
                    return
                connection, _, content = record
                message = self._deserialize(content, connection.msgtype)
            yield where, message
            number += 1

    def _deserialize(self, content: bytes, kind: str) -> Any:
        types = _typestore(self._is_ros1)
        return types.deserialize_ros1(content, kind) if self._is_ros1 else types.deserialize_cdr(content, kind)


@functools.cache
def _typestore(is_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not is_ros1:
        return get_typestore(Stores.LATEST)
    types = get_typestore(Stores.ROS1_NOETIC)
    for kind in _TRANSFORMS:  # which rosbags does not bring along
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return types


@contextlib.contextmanager
def _refusing(where: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # damaged recordings raise what rosbags, SQLite, the unpackers and YAML like
        kind = "" if type(error).__module__.startswith("rosbags") else f"{type(error).__name__}: "
        raise ValueError(f"{where}: cannot be read: {kind}{_shown(' '.join(str(error).split()))}") from None


def _shown(text: str) -> str:
    """A text of a recording, for messages."""
    text = text if text.isprintable() else repr(text)
    return text if len(text) <= 500 else text[:500] + "..."


def _frame(name: str) -> str:
    return name.removeprefix("/")  # ROS 1 wrote both


def _time_us(header: Any) -> int:
    return header.stamp.sec * 1_000_000 + header.stamp.nanosec // 1000


def _decode(cloud: Any, where: str, sensor: Sensor, max_points: int) -> np.ndarray:
    """The points of a PointCloud2, in the columns of :func:`~fcos_lidar_jax.data.point_files.read_points`."""
    width, height, step, pitch = cloud.width, cloud.height, cloud.point_step, cloud.row_step
    if width * height > max_points:
        raise ValueError(f"{where}: got {width} x {height} points, expected at most {max_points}")
    pitch = max(pitch, width * step) if height <= 1 else pitch  # some drivers leave it out in a single row
    if pitch < width * step:
        raise ValueError(f"{where}: row_step: got {pitch}, expected {width * step}, width x point_step, or more")
    if height and width and len(cloud.data) < (needed := (height - 1) * pitch + width * step):
        found = f"got {len(cloud.data)} bytes, expected at least {needed}"
        raise ValueError(f"{where}: data: {found} for {height} rows of {width} points of {step}")
    table = {}
    names = [field.name for field in cloud.fields]
    for column, aliases in _COLUMNS.items():
        name = next((alias for alias in aliases if alias in names), None)
        if name is None:
            if column in "xyz":
                found = ", ".join(map(_shown, names[:_MAX_LISTED])) or "none"
                raise ValueError(f"{where}: fields: got {found}, expected one named {column}")
            continue
        field = cloud.fields[names.index(name)]
        if field.datatype not in _NUMBERS or field.count > 1:
            found = f"{field.count} of datatype {field.datatype}"
            raise ValueError(f"{where}: field {name}: got {found}, expected one number of datatype 1 to 8")
        dtype = np.dtype((">" if cloud.is_bigendian else "<") + _NUMBERS[field.datatype])
        if field.offset + dtype.itemsize > step:
            found = f"{dtype.itemsize} bytes at offset {field.offset}"
            raise ValueError(f"{where}: field {name}: got {found}, expected a place within point_step {step}")
        if width and height:
            values = np.ndarray((height, width), dtype, cloud.data.data, field.offset, (pitch, step))
        else:
            values = np.zeros(0, dtype)
        table[column] = values.reshape(-1)
    return assemble_points(where, sensor, table)


def _poses(bag: _Bag, odometry: str | None, poses: Path | None) -> tuple[_PoseAt | None, list[str]]:
    """Where the sensor was, None where nobody asked, and lines on what was assumed."""
    if poses is not None:
        track = read_tum(poses)
        return lambda frame, time_us, where: track.at(time_us, f"{poses}: {where}"), []
    if odometry is None:
        return None, []
    if odometry == "tf":
        if not bag.topics(_TRANSFORMS):
            bag.choose("tf", _TRANSFORMS, "odometry")
        return _Transforms(bag).to_world, []
    odometry = bag.choose(odometry, _POSE, "odometry")
    track, child = _read_odometry(bag, odometry)
    if not child:
        note = "does not say of which frame its poses are: taken for those of the clouds' frame"
        at = lambda frame, time_us, where: track.at(time_us, f"{where}: {_shown(odometry)}")  # noqa: E731
        return at, [f"{_shown(odometry)} {note}"]
    transforms = _Transforms(bag)

    def to_world(frame: str, time_us: int, where: str) -> np.ndarray:
        pose = track.at(time_us, f"{where}: {_shown(odometry)}")
        return pose @ transforms.between(child, frame, time_us, where)

    return to_world, []


def _read_odometry(bag: _Bag, topic: str) -> tuple[PoseTrack, str]:
    """Poses of a topic, and of which frame they are: "" where the messages do not say."""
    rows, times, child = [], [], None
    for where, message in bag.messages(topic, _POSE):
        time_us = _time_us(message.header)
        if times and time_us <= times[-1]:
            raise ValueError(f"{where}: time: got {time_us} us after {times[-1]} us, expected a later one")
        of = _frame(getattr(message, "child_frame_id", ""))
        child = of if child is None else child
        if of != child:
            raise ValueError(f"{where}: child_frame_id: got {_shown(of)!r}, expected {_shown(child)!r} as before")
        pose = getattr(message.pose, "pose", message.pose)  # within one with covariance, as in odometry
        rows.append(_numbers(pose.orientation, pose.position))
        times.append(time_us)
    return _track(times, rows, f"{bag.path}: {_shown(topic)}"), child or ""


def _numbers(rotation: Any, translation: Any) -> tuple[float, ...]:
    return rotation.w, rotation.x, rotation.y, rotation.z, translation.x, translation.y, translation.z


def _track(times: Iterable[int], rows: Iterable[tuple[float, ...]], where: str) -> PoseTrack:
    values = np.array(list(rows), np.float64).reshape(-1, 7)
    if bad := find_bad_pose(values[:, :4], values[:, 4:]):
        raise ValueError(f"{where}: pose {bad[0]}: {bad[1]}")
    return PoseTrack(np.array(list(times), np.int64), values[:, :4], values[:, 4:])


class _Transforms:
    """The tree of frames of ``/tf_static`` and ``/tf``."""

    def __init__(self, bag: _Bag) -> None:
        self.path = bag.path
        self._static = dict[tuple[str, str], tuple[float, ...]]()
        self._moving = defaultdict[tuple[str, str], dict[int, tuple[float, ...]]](dict)
        self._parents = defaultdict[str, set[str]](set)
        self._tracks = dict[tuple[str, str], PoseTrack]()
        for topic in bag.topics(_TRANSFORMS):
            for _, message in bag.messages(topic, _TRANSFORMS):
                for each in message.transforms:
                    edge = _frame(each.child_frame_id), _frame(each.header.frame_id)
                    values = _numbers(each.transform.rotation, each.transform.translation)
                    self._parents[edge[0]].add(edge[1])
                    if topic.endswith("tf_static"):
                        self._static[edge] = values
                    else:  # some are sent twice
                        self._moving[edge].setdefault(_time_us(each.header), values)

    def between(self, to: str, frame: str, time_us: int, where: str) -> np.ndarray:
        """The pose of a frame in another one, f64[4, 4]."""
        up, down = self._ancestors(frame), self._ancestors(to)
        meet = next((name for name in up if name in down), None)
        if meet is None:
            known = ", ".join(_shown(name) for name in sorted(self._parents)[:_MAX_LISTED]) or "none"
            raise ValueError(
                f"{where}: no transform from {_shown(frame)!r} to {_shown(to)!r} in the recording, expected one in "
                f"/tf_static or /tf, which have those of: {known}"
            )
        pose = self._climb(up[: up.index(meet) + 1], time_us, where)
        return np.linalg.inv(self._climb(down[: down.index(meet) + 1], time_us, where)) @ pose

    def to_world(self, frame: str, time_us: int, where: str) -> np.ndarray:
        """The pose of a frame in ``odom``, or in its last ancestor, f64[4, 4]."""
        up = self._ancestors(frame)
        up = up[: up.index(_ODOM) + 1] if _ODOM in up else up
        if not any(edge in self._moving for edge in zip(up, up[1:], strict=False)):
            found = " -> ".join(map(_shown, up))
            raise ValueError(f"{where}: got the frames {found}, expected one that moves, by /tf")
        return self._climb(up, time_us, where)

    def _ancestors(self, frame: str) -> list[str]:
        """A frame, what it is in, and so on."""
        found = [frame]
        while parents := self._parents.get(found[-1]):
            parent, *others = sorted(parents)
            if others or parent in found:
                what = f"{len(parents)} parents" if others else "itself among those that it is in"
                raise ValueError(f"{self.path}: tf: frame {_shown(found[-1])!r} has {what}, expected a tree")
            found.append(parent)
        return found

    def _climb(self, frames: list[str], time_us: int, where: str) -> np.ndarray:
        """The pose of the first of a chain of frames in the last."""
        pose = np.eye(4)
        for edge in zip(frames, frames[1:], strict=False):
            if edge not in self._tracks:
                self._tracks[edge] = self._edge_track(edge)
            track, fixed = self._tracks[edge], len(self._tracks[edge].times_us) == 1
            at = int(track.times_us[0]) if fixed else time_us
            pose = track.at(at, f"{where}: tf of {_shown(edge[0])} in {_shown(edge[1])}") @ pose
        return pose

    def _edge_track(self, edge: tuple[str, str]) -> PoseTrack:
        """Poses of a frame in its parent; one where they never change, which needs no neighbours in time."""
        known = {0: self._static[edge]} if edge in self._static else self._moving[edge]
        known = known if len(set(known.values())) > 1 else dict([next(iter(known.items()))])
        return _track(sorted(known), (known[time] for time in sorted(known)), f"{self.path}: tf of {_shown(edge[0])}")
