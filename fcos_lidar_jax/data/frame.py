"""Annotated point clouds, and the protocol of data sets."""

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.point_files import check_time_lags
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class Frame:
    """Points and boxes of one keyframe in its LiDAR frame, unpadded.

    Attributes:
        points: f32[n, c]: x, y, z, intensity (0-255), time lag (s, 0 for the current sweep), and the laser number
            as a sixth column for sensors whose rows come from it.
        boxes: f32[m, 9]: x, y, z, l, w, h, yaw, vx, vy; NaN velocity where unknown.
        labels: i32[m]: index into the ``classes`` of the frame set.
        num_points: i32[m]: annotated number of LiDAR points of the current sweep in each box, -1 if unknown.
        num_close: number of points on the ego vehicle that the reader removed, see :func:`drop_close`.
        others: f32[k, 9]: boxes that a class map left out: nothing is pasted there.
    """

    points: np.ndarray
    boxes: np.ndarray
    labels: np.ndarray
    num_points: np.ndarray
    num_close: int = 0
    others: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 9), np.float32))


@runtime_checkable
class FrameSet(Protocol):
    """Frames in a fixed order: the interface of every reader for the training pipeline and the commands.

    Readers inherit from it and get defaults for anything that their data lack (poses, times, scenes).

    Raises:
        ValueError: at construction or on reading a frame, with the file, the place in it, the field, the found and
            the expected value.
    """

    classes: tuple[str, ...]  # Class names, which labels index.
    sensor: Sensor  # Sensor that recorded the points.

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """Read one frame: sweeps fused, close points removed, all boxes of the classes."""
        ...

    def truth(self, index: int) -> Frame:
        """:meth:`frame` with ``num_close`` 0 and no points.

        The points are read only if the data lack the number of points in each box (KITTI, folders of your own
        data).
        """
        return without_points(self.frame(index))

    def labels(self, index: int) -> np.ndarray:
        """i32[m]: labels of the frame's boxes, except boxes known to be empty; avoids reading the points."""
        truth = self.truth(index)
        return truth.labels[truth.num_points != 0]

    def name(self, index: int) -> str:
        """Unique name of a frame in messages and results files."""
        ...

    def fingerprint(self) -> str:
        """Checksum of everything that determines the frames, as far as it is known without reading the points."""
        ...

    def check_files(self, indices: Iterable[int]) -> None:
        """Refuse missing point files of some frames, and links that must not be followed, before one is read."""

    def clouds_fingerprint(self, indices: Iterable[int]) -> str:
        """Checksum of the name, size and modification time of some frames' point files.

        ``""`` if :meth:`fingerprint` includes them.
        """
        return ""

    def pose(self, index: int) -> np.ndarray | None:
        """f64[4, 4] from the points' frame to the world frame; None if unknown."""
        return None

    def time_us(self, index: int) -> int | None:
        """Time of the current sweep in microseconds; None if unknown."""
        return None

    def camera(self, index: int) -> tuple[Path, np.ndarray] | None:
        """An image of the frame, and f64[3, 4] from the points' frame to homogeneous pixels; None without one."""
        return None

    def scene(self, index: int) -> str:
        """Name of the frame's drive; ``""`` if unknown."""
        return ""


@dataclasses.dataclass(frozen=True)
class InMemoryFrames(FrameSet):
    """Frames in memory.

    Raises:
        ValueError: a label is not the index of a class, or the fifth column of the points is no time lag.
    """

    frames: tuple[Frame, ...]
    sensor: Sensor
    classes: tuple[str, ...]

    def __post_init__(self) -> None:
        for index, frame in enumerate(self.frames):
            known = (frame.labels >= 0) & (frame.labels < len(self.classes))
            expected = f"indices of the {len(self.classes)} classes"
            check(bool(known.all()), f"frame {index}: labels", frame.labels[~known].tolist(), expected)
            check_time_lags(frame.points[:, 4:5], f"frame {index}: points")

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        return self.frames[index]

    def name(self, index: int) -> str:
        return f"frame {index}"

    def fingerprint(self) -> str:
        arrays = (np.ascontiguousarray(a).tobytes() for frame in self.frames for a in vars(frame).values())
        return checksum(repr((self.classes, self.sensor, [checksum(data) for data in arrays])).encode())


def check_frames(frames: Any) -> None:
    """Refuse what is not a set of frames, such as the folder of a data set."""
    are_frames = hasattr(frames, "classes") and hasattr(frames, "frame")
    check(are_frames, "frames", type(frames).__name__, "a set of frames, as open_frames returns")


@dataclasses.dataclass(frozen=True)
class WrappedFrames(FrameSet):
    """Base of frame sets that change another one: everything is passed on unless a subclass overrides it."""

    frames: FrameSet
    classes: tuple[str, ...] = dataclasses.field(init=False)
    sensor: Sensor = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        check_frames(self.frames)
        object.__setattr__(self, "classes", self.frames.classes)
        object.__setattr__(self, "sensor", self.frames.sensor)

    def _source(self, index: int) -> int:
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

    def check_files(self, indices: Iterable[int]) -> None:
        self.frames.check_files(map(self._source, indices))

    def clouds_fingerprint(self, indices: Iterable[int]) -> str:
        return self.frames.clouds_fingerprint(map(self._source, indices))

    def pose(self, index: int) -> np.ndarray | None:
        return self.frames.pose(self._source(index))

    def time_us(self, index: int) -> int | None:
        return self.frames.time_us(self._source(index))

    def camera(self, index: int) -> tuple[Path, np.ndarray] | None:
        return self.frames.camera(self._source(index))

    def scene(self, index: int) -> str:
        return self.frames.scene(self._source(index))


@dataclasses.dataclass(frozen=True)
class SelectedFrames(WrappedFrames):
    """A selection of another set's frames, in any order."""

    indices: tuple[int, ...]

    def _source(self, index: int) -> int:
        return self.indices[index]

    def __len__(self) -> int:
        return len(self.indices)

    def fingerprint(self) -> str:
        return checksum(repr((self.frames.fingerprint(), self.indices)).encode())


def files_fingerprint(files: Iterable[Path], root: Path, reading: object) -> str:
    """Checksum of the name, size and modification time of files, and of the reader's options, distinguished by
    ``repr``.

    Names are relative to ``root``, so that a data set may be moved as a whole.
    """
    states = [(os.path.relpath(file, root), *size_and_time(file)) for file in sorted(files)]
    return checksum(repr((states, reading)).encode())


def size_and_time(file: Path) -> tuple[int, ...]:
    """Size in bytes and modification time in nanoseconds; ``()`` if the file is missing."""
    try:
        stat = file.stat()
    except FileNotFoundError:
        return ()
    return stat.st_size, stat.st_mtime_ns


def drop_close(points: np.ndarray, sensor: Sensor, reading: CloudReading) -> tuple[np.ndarray, int]:
    """Remove the points on the ego vehicle from f32[n, c]; also returns their number."""
    kept = np.asarray(remove_close(points, np.ones(len(points), bool), sensor, reading))
    return points[kept], len(points) - int(kept.sum())


def no_points(sensor: Sensor) -> np.ndarray:
    """An empty cloud f32[0, c] with the columns of a sensor."""
    return np.zeros((0, sensor.point_columns), np.float32)


def unlabelled(points: np.ndarray, num_close: int = 0) -> Frame:
    """A frame without boxes."""
    none = np.zeros(0, np.int32)
    return Frame(points, np.zeros((0, 9), np.float32), none, none, num_close)


def without_points(frame: Frame) -> Frame:
    """Drop a frame's points, and free their memory."""
    return dataclasses.replace(frame, points=frame.points[:0].copy(), num_close=0)  # a view would keep the cloud
