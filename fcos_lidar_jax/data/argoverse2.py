"""Argoverse 2 sensor data set: sweeps of two stacked LiDARs in the ego vehicle's frame, with tracked boxes."""

import dataclasses
import functools
from pathlib import Path
from typing import Literal

import numpy as np

from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES
from fcos_lidar_jax.data.box_geometry import LIMITS, find_bad_box
from fcos_lidar_jax.data.classes import unknown_name
from fcos_lidar_jax.data.frame import Frame, FrameSet, files_fingerprint
from fcos_lidar_jax.data.nuscenes.build import velocities
from fcos_lidar_jax.data.point_files import read_feather, read_points
from fcos_lidar_jax.data.sweeps import FARTHEST_M, Sweep, fuse_sweeps
from fcos_lidar_jax.geometry import pose_matrix, wrap_angle
from fcos_lidar_jax.sensors import ARGOVERSE2, Sensor

_SWEEPS = "sensors/lidar"
_POSES = "city_SE3_egovehicle.feather"
_BOXES = "annotations.feather"
_ROTATION = ("qw", "qx", "qy", "qz")
_TRANSLATION = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")


class Argoverse2Error(ValueError):
    """Argoverse 2 data that cannot be used: one line with the file, the row, the field, found and expected."""


class Argoverse2Frames(FrameSet):
    """All sweeps of some logs, by log and time: a :class:`~fcos_lidar_jax.data.frame.FrameSet`.

    Reads ``ROOT/[SPLIT/]LOG/sensors/lidar/TIMESTAMP_NS.feather``, ``LOG/city_SE3_egovehicle.feather`` and
    ``LOG/annotations.feather``; a log without annotations, as in the test split, has no boxes. Points and boxes
    stay in the frame of the ego vehicle (x forward, y left, z up). Boxes of the 26 classes of the detection
    benchmark; the taxonomy's other four are left out. Velocities are not annotated: they are those of the tracks
    in the city's frame, by the rule of :func:`~fcos_lidar_jax.data.nuscenes.build.velocities`, along the axes of
    the ego vehicle.

    Args:
        root: the folder of the splits, of logs, or of one log.
        split: its logs alone; all of them without it.
        sensor: whose points they are; with rows by laser number.
        num_sweeps: sweeps to fuse at most, the current one included; fewer at the beginning of a log.
        remove_close: drop the points on the ego vehicle around the sensor, judged in each sweep's own frame: of
            ``"all"`` sweeps, of the older ``"sweeps"``, or ``"none"``.
        close_m: half the side of the square that is emptied, metres.

    Raises:
        Argoverse2Error: here or on reading a frame, naming the file, the row, the field, found and expected.
        ValueError: a point file that cannot be used, in the same form.
    """

    classes = ARGOVERSE2_CLASSES

    def __init__(
        self,
        root: str | Path,
        split: str | None = None,
        *,
        sensor: Sensor = ARGOVERSE2,
        num_sweeps: int = 1,
        remove_close: Literal["all", "sweeps", "none"] = "sweeps",
        close_m: float = 1.0,
    ) -> None:
        """List the logs and their sweeps."""
        self.root, self.sensor, self.num_sweeps = Path(root), sensor, num_sweeps
        self.remove_close, self.close_m = remove_close, close_m
        splits = find_splits(self.root)
        if split is not None and split not in splits:
            raise Argoverse2Error(f"{self.root}: split: {unknown_name(split, splits)}")
        folders = [self.root / split] if split is not None else [self.root, *(self.root / s for s in splits)]
        logs = [log for folder in folders for log in _logs(folder)]
        if not logs:
            raise Argoverse2Error(f"{self.root}: no log in it, expected folders with {_SWEEPS}")
        self._sweeps = [(log, stamp, place) for log in logs for place, stamp in enumerate(_stamps(log))]

    def __len__(self) -> int:
        """Number of sweeps."""
        return len(self._sweeps)

    def frame(self, index: int) -> Frame:
        """One sweep, read anew, fused with those before it."""
        older = min(self._sweeps[index][2], self.num_sweeps - 1)
        chain = self._sweeps[index - older : index + 1][::-1]
        sweeps = (
            Sweep(read_points(_file(log, stamp), self.sensor), self._pose(log, stamp), stamp // 1000)
            for log, stamp, _ in chain
        )
        points, num_close = fuse_sweeps(sweeps, self.sensor, remove_close=self.remove_close, close_m=self.close_m)
        boxes, rows = self._rows(index)
        return Frame(points, boxes.boxes[rows], boxes.labels[rows], boxes.num_points[rows], num_close)

    def labels(self, index: int) -> np.ndarray:
        """i32[m]: labels of the sweep's boxes, without reading its points."""
        boxes, rows = self._rows(index)
        return boxes.labels[rows]

    def name(self, index: int) -> str:
        """The log's name and the sweep's time in nanoseconds."""
        log, stamp, _ = self._sweeps[index]
        return f"{log.name}_{stamp}"

    def pose(self, index: int) -> np.ndarray:
        """f64[4, 4] from the ego vehicle's frame to the city's."""
        return self._pose(*self._sweeps[index][:2])

    def time_us(self, index: int) -> int:
        """The sweep's time of reference, microseconds."""
        return self._sweeps[index][1] // 1000

    def scene(self, index: int) -> str:
        """The log's name."""
        return self._sweeps[index][0].name

    def fingerprint(self) -> str:
        """Checksum of the files by name, size and time of change, and of the sweeps and the reading options."""
        files = [_file(log, stamp) for log, stamp, _ in self._sweeps]
        for log in dict.fromkeys(log for log, _, _ in self._sweeps):
            files += [file for name in (_POSES, _BOXES) if (file := log / name).exists()]
        reading = self.sensor, self.num_sweeps, self.remove_close, self.close_m
        return files_fingerprint(files, self.root, reading)

    def _pose(self, log: Path, stamp: int) -> np.ndarray:
        return _read_poses(log).at(np.array([stamp]))[0]

    def _rows(self, index: int) -> tuple["_Boxes", slice]:
        log, stamp, _ = self._sweeps[index]
        boxes = _read_boxes(log)
        first, last = np.searchsorted(boxes.time_ns, (stamp, stamp + 1))
        return boxes, slice(first, last)


def find_splits(root: Path) -> list[str]:
    """Folders of logs in a folder."""
    return sorted(
        folder.name for folder in root.iterdir() if folder.is_dir() and next(folder.glob(f"*/{_SWEEPS}"), 0)
    )


def _logs(folder: Path) -> list[Path]:
    """The logs in a folder, or the folder where it is one."""
    return [folder] if (folder / _SWEEPS).is_dir() else sorted(p.parents[1] for p in folder.glob(f"*/{_SWEEPS}"))


def _file(log: Path, stamp: int) -> Path:
    return log / _SWEEPS / f"{stamp}.feather"


def _stamps(log: Path) -> list[int]:
    """Times of a log's sweeps in nanoseconds, from their files' names."""
    stamps = []
    for file in (log / _SWEEPS).glob("*.feather"):
        if not (file.stem.isascii() and file.stem.isdecimal()) or str(int(file.stem)) != file.stem:
            raise Argoverse2Error(f"{file}: got {file.stem!r}, expected a name of whole nanoseconds")
        stamps.append(int(file.stem))
    if not stamps:
        raise Argoverse2Error(f"{log / _SWEEPS}: no sweep in it, expected TIMESTAMP.feather files")
    return sorted(stamps)


@dataclasses.dataclass(frozen=True)
class _Poses:
    """Where the ego vehicle was."""

    file: Path
    time_ns: np.ndarray
    """i64[p], rising."""
    matrices: np.ndarray
    """f64[p, 4, 4], ego vehicle to city."""

    def at(self, time_ns: np.ndarray) -> np.ndarray:
        """f64[n, 4, 4] at exact times."""
        rows = np.minimum(np.searchsorted(self.time_ns, time_ns), len(self.time_ns) - 1)
        missing = time_ns[self.time_ns[rows] != time_ns]
        if len(missing):
            raise Argoverse2Error(f"{self.file}: no pose at {missing[0]} ns, expected one for every sweep and box")
        return self.matrices[rows]


@dataclasses.dataclass(frozen=True)
class _Boxes:
    """All boxes of a log, by time."""

    time_ns: np.ndarray
    """i64[m], rising."""
    boxes: np.ndarray
    """f32[m, 9]."""
    labels: np.ndarray
    """i32[m]."""
    num_points: np.ndarray
    """i32[m]."""


def _state(file: Path) -> tuple[int, int] | None:
    """What changes with the file, so that a changed one is read again."""
    return ((s := file.stat()).st_size, s.st_mtime_ns) if file.exists() else None


def _read_poses(log: Path) -> _Poses:
    return _cached_poses(log / _POSES, _state(log / _POSES))


def _read_boxes(log: Path) -> _Boxes:
    return _cached_boxes(log, _state(log / _BOXES), _state(log / _POSES))


@functools.lru_cache(maxsize=32)
def _cached_poses(file: Path, state: object) -> _Poses:
    table = _read_table(file, ("timestamp_ns", *_ROTATION, *_TRANSLATION))
    time_ns, first = np.unique(table["timestamp_ns"], return_index=True)
    if not len(time_ns):
        raise Argoverse2Error(f"{file}: no row in it, expected the poses of the ego vehicle")
    return _Poses(file, time_ns, _pose_matrices(file, table)[first])


@functools.lru_cache(maxsize=32)
def _cached_boxes(log: Path, *states: object) -> _Boxes:
    file = log / _BOXES
    if states[0] is None:
        none = np.zeros(0, np.int32)
        return _Boxes(np.zeros(0, np.int64), np.zeros((0, 9), np.float32), none, none)
    numbers = ("timestamp_ns", *_SIZE, *_ROTATION, *_TRANSLATION, "num_interior_pts")
    table = _read_table(file, numbers, ("track_uuid", "category"))
    in_ego, time_ns = _pose_matrices(file, table), table["timestamp_ns"]
    ego = _read_poses(log).at(time_ns)
    heading = in_ego[:, :3, 0]
    boxes = np.concatenate(
        [
            in_ego[:, :3, 3],
            np.stack([table[name] for name in _SIZE], axis=1),
            np.arctan2(heading[:, 1], heading[:, 0])[:, None],
            np.full((len(time_ns), 2), np.nan),
        ],
        axis=1,
    )
    bad = find_bad_box(boxes)
    if bad is not None:
        raise Argoverse2Error(f"{file}: row {bad[0]}: {bad[1]}")
    velocity = _track_velocities(table["track_uuid"], time_ns, (ego @ in_ego)[:, :3, 3], ego)
    # A track that jumps has none.
    possible = (np.abs(velocity) <= LIMITS["vx"]).all(axis=1)
    boxes[possible, 7:] = velocity[possible]
    boxes = boxes.astype(np.float32)
    boxes[:, 6] = wrap_angle(boxes[:, 6])
    place = {name: i for i, name in enumerate(ARGOVERSE2_CLASSES)}
    labels = np.array([place.get(name, -1) for name in table["category"]], np.int32)
    counts = np.clip(table["num_interior_pts"], 0, np.iinfo(np.int32).max).astype(np.int32)
    order = np.argsort(time_ns, kind="stable")
    order = order[labels[order] >= 0]
    return _Boxes(time_ns[order], boxes[order], labels[order], counts[order])


def _track_velocities(track: np.ndarray, time_ns: np.ndarray, in_city: np.ndarray, ego: np.ndarray) -> np.ndarray:
    """f64[m, 2]: velocity of every box along the ego vehicle's axes, NaN where it is not known."""
    _, track = np.unique(track.astype(str), return_inverse=True)
    order = np.lexsort((time_ns, track))
    follows = track[order][1:] == track[order][:-1]
    before, after = np.full(len(track), -1), np.full(len(track), -1)
    before[order[1:][follows]] = order[:-1][follows]
    after[order[:-1][follows]] = order[1:][follows]
    velocity = velocities(in_city, time_ns // 1000, before, after)
    return np.einsum("mij,mi->mj", ego[:, :3, :3], velocity)[:, :2]


def _pose_matrices(file: Path, table: dict[str, np.ndarray]) -> np.ndarray:
    rotation, translation = (np.stack([table[n] for n in names], axis=1) for names in (_ROTATION, _TRANSLATION))
    unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) < 1e-3
    near = (np.abs(translation) <= FARTHEST_M).all(axis=1)
    checks = (
        (_ROTATION, rotation, unit, "a unit quaternion"),
        (_TRANSLATION, translation, near, f"at most {FARTHEST_M:g} m"),
    )
    for names, values, good, expected in checks:
        if not good.all():
            row = int(np.argmin(good))
            found = ", ".join(f"{value:g}" for value in values[row])
            raise Argoverse2Error(f"{file}: row {row}: {', '.join(names)}: got {found}, expected {expected}")
    return pose_matrix(rotation, translation)


def _read_table(file: Path, numbers: tuple[str, ...], texts: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Columns of a table: whole numbers as i64, others as f64, texts as objects."""
    if not file.is_file():
        raise Argoverse2Error(f"{file}: no such file, expected one for every log")
    whole = [name for name in numbers if name in ("timestamp_ns", "num_interior_pts")]
    floats = read_feather(file, [name for name in numbers if name not in whole])
    columns = {name: column.astype(np.float64) for name, column in floats.items()}
    columns |= {name: column.astype(np.int64) for name, column in read_feather(file, whole, "iu").items()}
    return columns | read_feather(file, texts, "O")
