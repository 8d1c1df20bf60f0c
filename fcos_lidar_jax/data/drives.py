"""Drives: the sweeps of one sensor in temporal order, with poses if they are known."""

import dataclasses
import itertools
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fcos_lidar_jax.data.clouds import find_clouds
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.data.sweeps import Sweep, check_poses, read_entries
from fcos_lidar_jax.data.text_files import read_lines, read_number
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor

MAX_POSE_GAP_US = 500_000  # largest distance of neighbours between which poses are interpolated
_FASTEST_M_PER_S = 100.0  # between two poses
_MAX_GAP_S = 10.0  # between two sweeps
_MAX_RATIO = 3  # between the numbers of points in two clouds of one sensor
_LATEST_S = 1e12  # larger values are not timestamps
_UNITS_PER_US = {16: 1, **dict.fromkeys((17, 18, 19), 1000)}  # by digits of a name: microseconds, nanoseconds


@dataclasses.dataclass(frozen=True)
class Drive:
    """The sweeps of a recording. To support a new kind of recording, write a function that returns a Drive."""

    sweeps: Iterable[Sweep]  # in temporal order, read on demand
    posed: bool = True  # False: poses are unknown and replaced by the identity
    timed: bool = True  # False: times are unknown and replaced by 0, 1, ...
    at_us: Collection[int] | None = None  # times of the sweeps to detect in; None for all
    tokens: Mapping[int, str] = dataclasses.field(default_factory=dict)  # time -> sample token of nuScenes
    notes: list[str] = dataclasses.field(default_factory=list)
    """Notes about assumptions and, once the last sweep was read or one cannot be read, about skipped sweeps."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sweeps", _watched(self.sweeps))


def _watched(sweeps: Iterable[Sweep]) -> Iterator[Sweep]:
    """The sweeps; a note tells the first that cannot follow the one before in a drive of one sensor."""
    before: Sweep | None = None
    for sweep in sweeps:
        if before is not None and (line := _jump(before, sweep)):
            tell(f"note: {sweep.name}: {line} {before.name}: clouds of several sensors or drives?", once="jump")
        before = sweep
        yield sweep


def _jump(before: Sweep, sweep: Sweep) -> str | None:
    moved_m = float(np.linalg.norm(sweep.sensor_to_world[:3, 3] - before.sensor_to_world[:3, 3]))
    passed_s = (sweep.time_us - before.time_us) / 1e6
    if moved_m > _FASTEST_M_PER_S * passed_s > 0:
        return f"its pose is {moved_m:.1f} m away, {passed_s:g} s after"
    if passed_s > _MAX_GAP_S:
        return f"its time is {passed_s:g} s after"
    numbers = len(before.points), len(sweep.points)
    if max(numbers) > _MAX_RATIO * min(numbers) > 0:
        return f"it has {numbers[1]} points, after {numbers[0]} of"
    return None


PoseRow = tuple[float, ...]
"""Quaternion w, x, y, z and translation in metres."""


class OutsidePosesError(ValueError):
    """A time before the first or after the last pose."""


class PoseTrack(NamedTuple):
    """Poses of one object over time."""

    times_us: np.ndarray  # i64[n], increasing
    rotations: np.ndarray  # f64[n, 4], quaternions w, x, y, z
    translations: np.ndarray  # f64[n, 3], metres

    def at(self, time_us: int, where: str) -> np.ndarray:
        """The pose f64[4, 4] at a time, interpolated between neighbours at most :data:`MAX_POSE_GAP_US` apart.

        Raises:
            OutsidePosesError: with ``where``: the time is before the first or after the last pose.

        >>> track = PoseTrack(np.array([0, 400_000]), np.eye(4)[[0, 0]], np.array([[0.0, 0, 0], [2.0, 0, 0]]))
        >>> track.at(100_000, "poses")[0].tolist()
        [1.0, 0.0, 0.0, 0.5]
        """
        from scipy.spatial.transform import Rotation, Slerp  # SciPy takes long to import

        known_us, rotations, translations = self
        last = int(np.searchsorted(known_us, time_us - 1))
        if last < len(known_us) and known_us[last] <= time_us + 1:  # programs round times up or down
            return pose_matrix(rotations[last], translations[last])
        outside = not 0 < last < len(known_us)
        if outside or known_us[last] - known_us[last - 1] > MAX_POSE_GAP_US:
            raise (OutsidePosesError if outside else ValueError)(
                f"{where}: at {time_us / 1e6} s: a gap in the poses, expected one before and one after it, at "
                f"most {MAX_POSE_GAP_US / 1e6:g} s apart"
            )
        ends = slice(last - 1, last + 1)
        share = (time_us - known_us[last - 1]) / (known_us[last] - known_us[last - 1])
        turn = Slerp([0, 1], Rotation.from_quat(rotations[ends], scalar_first=True))(share)
        place = (1 - share) * translations[last - 1] + share * translations[last]
        return pose_matrix(turn.as_quat(scalar_first=True), place)


def make_track(times_us: Sequence[int], rows: Sequence[PoseRow], place: Callable[[int], str]) -> PoseTrack:
    """A track of poses at increasing times; ``place`` names a pose in messages."""
    for row, (before, after) in enumerate(itertools.pairwise(times_us), 1):
        if after <= before:
            found = f"got {after / 1e6} s after {before / 1e6} s"
            raise ValueError(f"{place(row)}: time: {found}, expected a later one")
    poses = np.array(rows, np.float64).reshape(-1, 7)
    check_poses(poses[:, :4], poses[:, 4:], place)
    return PoseTrack(np.array(times_us, np.int64), poses[:, :4], poses[:, 4:])


def folder_drive(folder: Path, sensor: Sensor, poses: Path | None = None, **layout: Any) -> Drive:
    """The clouds of a folder, or one file.

    Args:
        folder: point files, see :func:`read_points`; sorted by time if all names are times, else by name.
        poses: from the sensor to the world. ``.json``: a list of ``{"file", "timestamp_us", "sensor_to_world"}``
            in temporal order, files relative to the list. Other names: lines ``t x y z qx qy qz qw`` (TUM), t in
            seconds. If the clouds' names are times (seconds with a decimal point, or nanoseconds), poses are
            interpolated between neighbours at most 0.5 s apart; otherwise the file must have one
            line per cloud.
        layout: options of :func:`read_points`.
    """
    files = list(find_clouds((folder,)))
    if poses is None:
        files, _ = _in_order(files, folder)
        times, matrices = list(range(len(files))), [np.eye(4)] * len(files)
    elif poses.suffix == ".json":
        files, times, matrices = _listed(files, poses)
    else:
        files, times, matrices = _posed(files, poses)

    def read() -> Iterator[Sweep]:
        for file, time_us, matrix in zip(files, times, matrices, strict=True):
            yield Sweep(read_points(file, sensor, num_sweeps=1, **layout), matrix, time_us, str(file))

    return Drive(read(), posed=poses is not None, timed=poses is not None)


def _listed(files: list[Path], poses: Path) -> tuple[list[Path], list[int], list[np.ndarray]]:
    """Clouds, times and poses in the order of a JSON list."""
    listed = read_entries(poses)
    entries = {(poses.parent / entry.file).resolve(): entry for entry in listed}
    if len(entries) < len(listed):
        raise ValueError(f"{poses}: got {len(listed)} entries for {len(entries)} clouds, expected each once")
    clouds = {file.resolve(): file for file in files}
    for place, file in clouds.items():
        if place not in entries:
            raise ValueError(f"{poses}: no pose of {file}, expected an entry for every cloud")
    ordered = [(clouds[place], entry) for place, entry in entries.items() if place in clouds]
    times = [entry.timestamp_us for _, entry in ordered]
    return [file for file, _ in ordered], times, [np.array(entry.sensor_to_world) for _, entry in ordered]


def _posed(files: list[Path], path: Path) -> tuple[list[Path], list[int], list[np.ndarray]]:
    """Clouds in temporal order, with times and poses from a file of lines."""
    track = read_tum(path)
    files, times = _in_order(files, path)
    if times is None:
        if len(files) != len(track.times_us):
            raise ValueError(
                f"{path}: got {len(track.times_us)} poses for {len(files)} clouds, expected one per cloud, or "
                f"clouds whose names are times (seconds with a decimal point, or nanoseconds)"
            )
        return files, track.times_us.tolist(), list(pose_matrix(track.rotations, track.translations))
    return files, times, [track.at(time, f"{path}: {file}") for file, time in zip(files, times, strict=True)]


def _in_order(files: list[Path], where: Path) -> tuple[list[Path], list[int] | None]:
    """Clouds in temporal order: with their times if all names are times, else sorted by name, and None."""
    timed = sorted((time, file) for file in files if (time := _time_of(file)) is not None)
    if len(timed) == len(files):
        return [file for _, file in timed], [time for time, _ in timed]
    for before, after in itertools.pairwise(files):
        if _in_parts(before.name) > _in_parts(after.name):
            raise ValueError(
                f"{where}: clouds are sorted by name: got {before.name} before {after.name}, expected numbers of "
                f"one length, or poses in FILE.json"
            )
    return files, None


def _in_parts(name: str) -> list[str | int]:
    """A sort key that compares numbers in names by value."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _time_of(file: Path) -> int | None:
    """Microseconds if the name is a time, else None.

    >>> _time_of(Path("12.5.bin")), _time_of(Path("1532402927647951000.npy")), _time_of(Path("000012.bin"))
    (12500000, 1532402927647951, None)
    """
    stem = file.name.lower().removesuffix(".bin").removesuffix(".pcd").removesuffix(file.suffix.lower())
    whole, point, part = stem.partition(".")
    if not (whole.isdecimal() and (part or "0").isdecimal()):
        return None
    if point:
        return int(Decimal(stem) * 1_000_000) if float(stem) < _LATEST_S else None
    return int(stem) // unit if (unit := _UNITS_PER_US.get(len(stem))) else None


def read_tum(path: Path) -> PoseTrack:
    """Read poses from lines ``t x y z qx qy qz qw``; lines that begin with # are skipped."""
    places, times, rows = [], [], []
    for where, words in read_lines(path, "poses"):
        if words[0].startswith("#"):
            continue
        if len(words) != 8:
            raise ValueError(f"{where}: got {' '.join(words)[:80]!r}, expected t x y z qx qy qz qw")
        _, x, y, z, *vector, scalar = (read_number(word, where, largest=_LATEST_S) for word in words)
        places.append(where)
        times.append(int(Decimal(words[0]) * 1_000_000))  # a float cannot represent today's microseconds
        rows.append((scalar, *vector, x, y, z))
    if not rows:
        raise ValueError(f"{path}: no pose in it, expected lines t x y z qx qy qz qw")
    track = make_track(times, rows, places.__getitem__)
    w, x, y, z = track.rotations.T
    if len(inverted := np.flatnonzero(x * x + y * y > w * w + z * z)):
        expected = "expected t x y z qx qy qz qw, with qw last"
        tell(f"note: {places[inverted[0]]}: turns z down: {expected}", once="z down")
    return track
