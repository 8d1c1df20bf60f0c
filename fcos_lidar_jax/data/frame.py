"""Annotated clouds, and what a data set of them offers."""

import dataclasses
import os
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class Frame:
    """Points and boxes of one keyframe in its LiDAR frame, unpadded.

    Attributes:
        points: f32[n, c]: x, y, z, intensity (0-255), time lag (s, 0 for the current sweep), and the laser number
            as a sixth column for sensors whose rows come from it.
        boxes: f32[m, 9]: ``x, y, z, l, w, h, yaw, vx, vy``; NaN velocity where unknown.
        labels: i32[m]: index into the ``classes`` of the frame set.
        num_points: i32[m]: LiDAR points of the current sweep inside each box, as annotated.
        num_close: points on the ego vehicle that the reader has removed, of all sweeps.

    >>> points, boxes = np.zeros((1, 5), np.float32), np.array([[0, 0, 0, 4, 2, 2, 0, 0, 0]], np.float32)
    >>> Frame(points, boxes, labels=np.array([0]), num_points=np.array([1])).boxes[0, 3:6].tolist()
    [4.0, 2.0, 2.0]
    """

    points: np.ndarray
    boxes: np.ndarray
    labels: np.ndarray
    num_points: np.ndarray
    num_close: int = 0


@runtime_checkable
class FrameSet(Protocol):
    """Frames in a fixed order: what every reader offers to the training pipeline and the commands.

    Readers inherit from it, so that what their data do not have (poses, times, scenes) has its default.

    Attributes:
        classes: what labels count, in their order.
        sensor: whose points they are.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> frames: FrameSet = SimulatedFrames(TINY, 3)
    >>> len(frames), frames.frame(0).points.shape[1], frames.classes[0]
    (3, 5, 'car')
    """

    classes: tuple[str, ...]
    sensor: Sensor

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """One frame, read anew: sweeps fused, close points removed, all boxes of the classes."""
        ...

    def truth(self, index: int) -> Frame:
        """The boxes of :meth:`frame` with their labels and numbers of points, all the same, but without the cloud.

        Where the set can, the points are not read. It cannot where the data do not say how many points a box
        holds, as in KITTI and folders of own data: they are then counted.

        Returns:
            a frame of no points, from which none was removed.
        """
        return without_points(self.frame(index))

    def labels(self, index: int) -> np.ndarray:
        """i32[m]: labels of the frame's boxes, without those that are known to hold no point; where the set can,
        without reading the points."""
        return self.truth(index).labels

    def name(self, index: int) -> str:
        """What messages and files of results call a frame, in any letters; no two frames have the same name."""
        ...

    def fingerprint(self) -> str:
        """A checksum of all that the frames follow from, as far as it can be known without reading the points."""
        ...

    def clouds_fingerprint(self, indices: Iterable[int]) -> str:
        """Checksum of the point files of some frames by name, size and time of their last change.

        For sets whose :meth:`fingerprint` does not see them; ``""`` where it does.
        """
        return ""

    def pose(self, index: int) -> np.ndarray | None:
        """f64[4, 4] from the points' frame to the world's, None where it is not known."""
        return None

    def time_us(self, index: int) -> int | None:
        """When the current sweep was taken, microseconds, None where it is not known."""
        return None

    def scene(self, index: int) -> str:
        """Name of the drive that the frame is of, ``""`` where it is not known."""
        return ""


@dataclasses.dataclass(frozen=True)
class GivenFrames(FrameSet):
    """Frames in memory.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> nothing = Frame(np.zeros((0, 5)), np.zeros((0, 9)), np.zeros(0, int), np.zeros(0, int))
    >>> len(GivenFrames((nothing,), TINY, ("car",)))
    1
    """

    frames: tuple[Frame, ...]
    sensor: Sensor
    classes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        return self.frames[index]

    def name(self, index: int) -> str:
        return f"frame {index}"

    def fingerprint(self) -> str:
        arrays = (np.ascontiguousarray(a).tobytes() for frame in self.frames for a in vars(frame).values())
        return checksum(repr((self.classes, self.sensor, [checksum(data) for data in arrays])).encode())


@dataclasses.dataclass(frozen=True)
class FramesOf(FrameSet):
    """A frame set made of another, from which it has whatever it does not define itself."""

    frames: FrameSet
    classes: tuple[str, ...] = dataclasses.field(init=False)
    sensor: Sensor = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", self.frames.classes)
        object.__setattr__(self, "sensor", self.frames.sensor)

    def _source(self, index: int) -> int:
        """Which of the frames is meant."""
        return index

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        return self.frames.frame(self._source(index))

    def truth(self, index: int) -> Frame:
        return self.frames.truth(self._source(index))

    def labels(self, index: int) -> np.ndarray:
        return self.frames.labels(self._source(index))

    def name(self, index: int) -> str:
        return self.frames.name(self._source(index))

    def fingerprint(self) -> str:
        return self.frames.fingerprint()

    def clouds_fingerprint(self, indices: Iterable[int]) -> str:
        return self.frames.clouds_fingerprint(map(self._source, indices))

    def pose(self, index: int) -> np.ndarray | None:
        return self.frames.pose(self._source(index))

    def time_us(self, index: int) -> int | None:
        return self.frames.time_us(self._source(index))

    def scene(self, index: int) -> str:
        return self.frames.scene(self._source(index))


@dataclasses.dataclass(frozen=True)
class ChosenFrames(FramesOf):
    """Some of the frames, in any order.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> ChosenFrames(SimulatedFrames(TINY, 5), (4, 2)).name(1)
    'seed 2'
    """

    indices: tuple[int, ...]

    def _source(self, index: int) -> int:
        return self.indices[index]

    def __len__(self) -> int:
        return len(self.indices)

    def fingerprint(self) -> str:
        return checksum(repr((self.frames.fingerprint(), self.indices)).encode())


def files_fingerprint(files: Iterable[Path], root: Path, reading: object) -> str:
    """Checksum of files by name, size and time of their last change, and of how they are read.

    Args:
        root: names are relative to it, also those of files outside, so that a data set may be moved as a whole.
        reading: options of the reader, distinguished by ``repr``.
    """
    states = [(os.path.relpath(file, root), *_size_and_time(file)) for file in sorted(files)]
    return checksum(repr((states, reading)).encode())


def _size_and_time(file: Path) -> tuple[int, ...]:
    """Bytes, and nanoseconds of the last change; nothing where there is no file."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return ()
    return found.st_size, found.st_mtime_ns


def distinct_names(listed: Iterable[tuple[str, str]], known: Collection[str], where: str) -> tuple[str, ...]:
    """Names of frames, each known and listed once, at least one.

    Args:
        listed: where each is, for messages, and the name.
        where: the list is, for messages.

    Raises:
        ValueError: naming the place, what was found and what was expected.
    """
    names: dict[str, None] = {}
    for place, name in listed:
        if name not in known:
            raise ValueError(f"{place}: got {name!r}, expected the name of a cloud")
        if name in names:
            raise ValueError(f"{place}: got {name!r} a second time, expected every frame once")
        names[name] = None
    if not names:
        raise ValueError(f"{where}: no frame in it, expected at least one")
    return tuple(names)


def drop_close(points: np.ndarray, sensor: Sensor, *, mode: str, close_m: float) -> tuple[np.ndarray, int]:
    """A cloud f32[n, c] without the points on the ego vehicle, and how many they were.

    Mode and metres are those of :func:`fcos_lidar_jax.projection.remove_close`.
    """
    kept = np.asarray(remove_close(points, np.ones(len(points), bool), sensor, mode=mode, close_m=close_m))
    return points[kept], len(points) - int(kept.sum())


def no_points(sensor: Sensor) -> np.ndarray:
    """A cloud without points, f32[0, c], of a sensor's columns.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> no_points(TINY).shape
    (0, 5)
    """
    return np.zeros((0, sensor.point_columns), np.float32)


def without_points(frame: Frame) -> Frame:
    """The boxes of a frame alone; keeps nothing of the cloud in memory.

    >>> frame = Frame(np.zeros((9, 5)), np.zeros((1, 9)), np.zeros(1, int), np.ones(1, int), num_close=4)
    >>> boxes = without_points(frame)
    >>> boxes.points.shape, boxes.num_points.tolist(), boxes.num_close
    ((0, 5), [1], 0)
    """
    return dataclasses.replace(frame, points=frame.points[:0].copy(), num_close=0)  # a view would keep the cloud


def without_close(frame: Frame, sensor: Sensor, *, mode: str = "all", close_m: float = 1.0) -> Frame:
    """The frame without the points on the ego vehicle, as detectors are trained; as :func:`drop_close`.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> frame = Frame(np.eye(5, dtype=np.float32) * 9, np.zeros((0, 9)), np.zeros(0), np.zeros(0))
    >>> len(without_close(frame, TINY).points)
    2
    """
    points, number = drop_close(frame.points, sensor, mode=mode, close_m=close_m)
    return dataclasses.replace(frame, points=points, num_close=frame.num_close + number)
