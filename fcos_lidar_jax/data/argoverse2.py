"""Argoverse 2 sensor data set: sweeps of two stacked LiDARs in the ego vehicle's frame, with tracked boxes."""

import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import LIMITS, check_boxes
from fcos_lidar_jax.data.class_mapping import map_labels
from fcos_lidar_jax.data.drives import Drive
from fcos_lidar_jax.data.frame import Frame, FrameSet, files_fingerprint, no_points, size_and_time
from fcos_lidar_jax.data.nuscenes.build import velocities
from fcos_lidar_jax.data.point_files import MAX_POINTS, read_feather, read_points
from fcos_lidar_jax.data.sweeps import Sweep, check_poses, fuse_sweeps
from fcos_lidar_jax.files import some_files
from fcos_lidar_jax.geometry import pose_matrix, wrap_angle
from fcos_lidar_jax.sensors import ARGOVERSE2, Sensor

_SWEEPS = "sensors/lidar"
_POSES = "city_SE3_egovehicle.feather"
_BOXES = "annotations.feather"
_ROTATION = ("qw", "qx", "qy", "qz")
_TRANSLATION = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")
_POSE = {"timestamp_ns": "iu", **dict.fromkeys((*_ROTATION, *_TRANSLATION), "fiu")}
_BOX = {**_POSE, **dict.fromkeys(_SIZE, "fiu"), "num_interior_pts": "iu", "track_uuid": "O", "category": "O"}
"""Column -> NumPy's type letters that it may have."""

TO_NUSCENES = {
    **dict.fromkeys(ARGOVERSE2_CLASSES),
    "REGULAR_VEHICLE": "car",
    **dict.fromkeys(("LARGE_VEHICLE", "TRUCK", "BOX_TRUCK", "TRUCK_CAB"), "truck"),
    **dict.fromkeys(("BUS", "SCHOOL_BUS", "ARTICULATED_BUS"), "bus"),
    **dict.fromkeys(("VEHICULAR_TRAILER", "MESSAGE_BOARD_TRAILER"), "trailer"),
    "PEDESTRIAN": "pedestrian",
    "MOTORCYCLE": "motorcycle",
    "BICYCLE": "bicycle",
    "CONSTRUCTION_CONE": "traffic_cone",
}
"""Class map from Argoverse 2's classes to the ten nuScenes classes; None drops the object. Riders are dropped,
because their bicycles have boxes of their own. A pickup, a truck in nuScenes, is a regular vehicle here and so a
car."""


class Argoverse2Frames(FrameSet):
    """All sweeps of some logs, by log and time: a :class:`~fcos_lidar_jax.data.frame.FrameSet`.

    Reads ``ROOT/[SPLIT/]LOG/sensors/lidar/TIMESTAMP_NS.feather``, ``LOG/city_SE3_egovehicle.feather`` and
    ``LOG/annotations.feather``; ``root`` may also be one log. A log without annotations, as in the test split, has
    no boxes. Points and boxes stay in the ego vehicle's frame (x forward, y left, z up). Boxes outside the 26
    classes of the detection benchmark are dropped. Velocities are not annotated: they follow from the tracks in
    the city frame, by the rule of :func:`~fcos_lidar_jax.data.nuscenes.build.velocities`, and are given along the
    ego vehicle's axes.
    """

    classes = ARGOVERSE2_CLASSES

    def __init__(
        self,
        root: str | Path,
        split: str | None = None,
        *,
        sensor: Sensor = ARGOVERSE2,
        reading: CloudReading = CloudReading(),
    ) -> None:
        self.root, self.sensor, self.reading = Path(root), sensor, reading
        splits = [self.root / name for name in find_splits(self.root)]
        folders = [self.root, *splits] if split is None else [self.root / split]
        logs = [log for folder in folders for log in _logs(folder)]
        if not logs:
            raise ValueError(f"{folders[0]}: no log in it, expected folders with {_SWEEPS}")
        self._sweeps = [(log, stamp, place) for log in logs for place, stamp in enumerate(_stamps(log))]

    def __len__(self) -> int:
        return len(self._sweeps)

    def frame(self, index: int) -> Frame:
        older = min(self._sweeps[index][2], self.reading.num_sweeps - 1)
        chain = range(index, index - older - 1, -1)
        sweeps = (Sweep(read_points(self._file(i), self.sensor), self.pose(i), self.time_us(i)) for i in chain)
        points, num_close = fuse_sweeps(sweeps, self.sensor, self.reading)
        return Frame(points, *self._boxes(index), num_close)

    def truth(self, index: int) -> Frame:
        return Frame(no_points(self.sensor), *self._boxes(index))

    def name(self, index: int) -> str:
        """The log's name and the sweep's time in nanoseconds."""
        log, stamp, _ = self._sweeps[index]
        return f"{log.name}_{stamp}"

    def pose(self, index: int) -> np.ndarray:
        log, stamp, _ = self._sweeps[index]
        return _read_log(log)[0].at(stamp)

    def time_us(self, index: int) -> int:
        return self._sweeps[index][1] // 1000

    def scene(self, index: int) -> str:
        return self._sweeps[index][0].name

    def fingerprint(self) -> str:
        files = [self._file(index) for index in range(len(self))]
        for log in dict.fromkeys(log for log, _, _ in self._sweeps):
            files += [file for name in (_POSES, _BOXES) if (file := log / name).exists()]
        return files_fingerprint(files, self.root, (self.sensor, *dataclasses.astuple(self.reading)))

    def _file(self, index: int) -> Path:
        log, stamp, _ = self._sweeps[index]
        return log / _SWEEPS / f"{stamp}.feather"

    def _boxes(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        log, stamp, _ = self._sweeps[index]
        _, (time_ns, *columns) = _read_log(log)
        first, last = np.searchsorted(time_ns, (stamp, stamp + 1))
        boxes, labels, num_points = (column[first:last] for column in columns)
        return boxes, labels, num_points


def is_argoverse2_log(folder: Path) -> bool:
    """Whether a folder is a log, such as ``sensor/val/LOG``."""
    return (folder / _SWEEPS).is_dir()


def argoverse2_drive(log: Path, sensor: Sensor, *, max_points: int = MAX_POINTS) -> Drive:
    """The sweeps of a log in temporal order, in the ego vehicle's frame, with poses in the city frame."""
    poses, stamps = _read_poses(log / _POSES), _stamps(log)

    def read() -> Iterator[Sweep]:
        for stamp in stamps:
            file = log / _SWEEPS / f"{stamp}.feather"
            points = read_points(file, sensor, max_points=max_points)
            yield Sweep(points, poses.at(stamp), stamp // 1000, str(file))

    return Drive(read())


def find_splits(root: Path) -> list[str]:
    """Names of the folders that contain logs."""
    return sorted(
        folder.name for folder in root.iterdir() if folder.is_dir() and next(folder.glob(f"*/{_SWEEPS}"), 0)
    )


def _logs(folder: Path) -> list[Path]:
    """The logs in a folder, or the folder itself if it is a log."""
    return [folder] if is_argoverse2_log(folder) else sorted(p.parents[1] for p in folder.glob(f"*/{_SWEEPS}"))


def _stamps(log: Path) -> list[int]:
    """Times of a log's sweeps in nanoseconds, from the file names."""
    stamps = []
    for file in some_files(log / _SWEEPS, ".feather", "sweeps, TIMESTAMP.feather"):
        if not re.fullmatch("0|[1-9][0-9]*", file.stem):
            raise ValueError(f"{file}: got {file.stem!r}, expected a name of whole nanoseconds")
        stamps.append(int(file.stem))
    return sorted(stamps)


@dataclasses.dataclass(frozen=True)
class _Poses:
    file: Path
    time_ns: np.ndarray  # i64[p], increasing
    matrices: np.ndarray  # f64[p, 4, 4], ego vehicle to city

    def at(self, time_ns: np.ndarray | int) -> np.ndarray:
        """f64[..., 4, 4] at exact times."""
        missing = np.setdiff1d(time_ns, self.time_ns)
        if len(missing):
            raise ValueError(f"{self.file}: no pose at {missing[0]} ns, expected one for every sweep and box")
        return self.matrices[np.searchsorted(self.time_ns, time_ns)]


class _Boxes(NamedTuple):
    time_ns: np.ndarray  # i64[m], increasing
    boxes: np.ndarray  # f32[m, 9]
    labels: np.ndarray  # i32[m]
    num_points: np.ndarray  # i32[m]


def _read_log(log: Path) -> tuple[_Poses, _Boxes]:
    """Poses and boxes of a log, cached until one of its files changes."""
    files = (log / _POSES, log / _BOXES)
    return _cached_log(*files, *map(size_and_time, files))


@functools.lru_cache(maxsize=32)
def _cached_log(pose_file: Path, box_file: Path, *states: object) -> tuple[_Poses, _Boxes]:
    poses = _read_poses(pose_file)
    if box_file.exists():
        return poses, _read_boxes(box_file, poses)
    none = np.zeros(0, np.int32)
    return poses, _Boxes(np.zeros(0, np.int64), np.zeros((0, 9), np.float32), none, none)


def _read_poses(file: Path) -> _Poses:
    table, matrices = _read_table(file, _POSE)
    time_ns, first = np.unique(table["timestamp_ns"], return_index=True)
    return _Poses(file, time_ns, matrices[first])


def _read_boxes(file: Path, poses: _Poses) -> _Boxes:
    table, in_ego = _read_table(file, _BOX)
    time_ns = table["timestamp_ns"]
    ego, heading = poses.at(time_ns), in_ego[:, :3, 0]
    boxes = np.full((len(time_ns), 9), np.nan)
    boxes[:, :3] = in_ego[:, :3, 3]
    boxes[:, 3:6] = np.stack([table[name] for name in _SIZE], axis=1)
    boxes[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    check_boxes(boxes, lambda row: f"{file}: row {row}")
    velocity = _track_velocities(table["track_uuid"], time_ns, (ego @ in_ego)[:, :3, 3], ego)
    possible = (np.abs(velocity) <= LIMITS["vx"]).all(axis=1)  # the velocity of a jumping track is unknown
    boxes[possible, 7:] = velocity[possible]
    boxes = boxes.astype(np.float32)
    boxes[:, 6] = wrap_angle(boxes[:, 6])
    labels = map_labels(table["category"].tolist(), ARGOVERSE2_CLASSES)
    counts = np.clip(table["num_interior_pts"], 0, np.iinfo(np.int32).max).astype(np.int32)
    order = np.argsort(time_ns, kind="stable")
    order = order[labels[order] >= 0]
    return _Boxes(time_ns[order], boxes[order], labels[order], counts[order])


def _track_velocities(track: np.ndarray, time_ns: np.ndarray, in_city: np.ndarray, ego: np.ndarray) -> np.ndarray:
    """f64[m, 2]: velocity of every box along the ego vehicle's axes, NaN if unknown."""
    _, track = np.unique(track.astype(str), return_inverse=True)
    order = np.lexsort((time_ns, track))
    follows = track[order][1:] == track[order][:-1]
    before, after = np.full(len(track), -1), np.full(len(track), -1)
    before[order[1:][follows]] = order[:-1][follows]
    after[order[:-1][follows]] = order[1:][follows]
    velocity = velocities(in_city, time_ns // 1000, before, after)
    return np.einsum("mij,mi->mj", ego[:, :3, :3], velocity)[:, :2]


def _read_table(file: Path, kinds: Mapping[str, str]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns of a table (integers as i64, other numbers as f64, text as objects) and the pose of every row."""
    wide = {"fiu": np.float64, "iu": np.int64, "O": object}
    table = {name: column.astype(wide[kinds[name]]) for name, column in read_feather(file, kinds).items()}
    rotation, translation = (np.stack([table[n] for n in names], axis=1) for names in (_ROTATION, _TRANSLATION))
    check_poses(rotation, translation, lambda row: f"{file}: row {row}")
    return table, pose_matrix(rotation, translation)
