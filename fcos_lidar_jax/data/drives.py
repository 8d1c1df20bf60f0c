"""Drives: the sweeps of one sensor in the order of time, with their poses where these are known."""

import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fcos_lidar_jax.data.clouds import find_clouds
from fcos_lidar_jax.data.point_files import MAX_POINTS, read_points
from fcos_lidar_jax.data.sweeps import Sweep, find_bad_pose, read_entries
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.sensors import Sensor

MAX_POSE_GAP_US = 500_000  # Poses are interpolated between neighbours that are at most so far apart.
_LATEST_S = 1e12  # Later times are none.
_NANOSECOND_DIGITS = range(16, 20)  # File names of so many digits are nanoseconds.


@dataclasses.dataclass(frozen=True)
class Drive:
    """Sweeps as they come. A new kind of recording is a function that returns this."""

    sweeps: Iterable[Sweep]  # read as they are asked for, in the order of time
    posed: bool = True  # False: poses are not known; the identity stands for them
    timed: bool = True  # False: times are not known; 0, 1, ... stand for them
    notes: list[str] = dataclasses.field(default_factory=list)
    """Lines on what was assumed and what was left out, the latter when the last sweep has been read."""


class OutsidePosesError(ValueError):
    """A time before the first or after the last pose."""


class PoseTrack(NamedTuple):
    """Poses of one thing over time."""

    times_us: np.ndarray  # i64[n], increasing
    rotations: np.ndarray  # f64[n, 4], quaternions w, x, y, z
    translations: np.ndarray  # f64[n, 3], metres

    def at(self, time_us: int, where: str) -> np.ndarray:
        """The pose f64[4, 4] at a time: translation and rotation interpolated between the neighbours.

        Raises:
            OutsidePosesError: naming ``where``: there is no pose before the time, or none after it.
            ValueError: the neighbours are more than :data:`MAX_POSE_GAP_US` apart.

        >>> track = PoseTrack(np.array([0, 400_000]), np.eye(4)[[0, 0]], np.array([[0.0, 0, 0], [2.0, 0, 0]]))
        >>> track.at(100_000, "poses")[0].tolist()
        [1.0, 0.0, 0.0, 0.5]
        """
        known_us, rotations, translations = self
        last = int(np.searchsorted(known_us, time_us))
        if last < len(known_us) and known_us[last] == time_us:
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


def folder_drive(
    folder: Path,
    sensor: Sensor,
    poses: Path | None = None,
    *,
    columns: int | None = None,
    dtype: str | None = None,
    max_points: int = MAX_POINTS,
) -> Drive:
    """The clouds of a folder, or one file.

    Args:
        folder: point files, see :func:`read_points`; without poses in the order of their names.
        poses: from the sensor to the world. ``.json``: a list of ``{"file", "timestamp_us", "sensor_to_world"}``
            in the order of time, files relative to the list. Others: lines ``t x y z qx qy qz qw`` (TUM), t in
            seconds. Where the names of the clouds are times (seconds with a decimal point, or nanoseconds), poses
            are interpolated between neighbours at most :data:`MAX_POSE_GAP_US` apart; otherwise there must be one
            line a cloud.
        columns, dtype, max_points: of raw files, as in :func:`read_points`.

    Raises:
        ValueError: naming the file, what was found and what was expected.
    """
    files = list(find_clouds((folder,)))
    if poses is None:
        times, matrices = list(range(len(files))), [np.eye(4)] * len(files)
    elif poses.suffix == ".json":
        files, times, matrices = _listed(files, poses)
    else:
        files, times, matrices = _posed(files, poses)

    def read() -> Iterator[Sweep]:
        for file, time_us, matrix in zip(files, times, matrices, strict=True):
            points = read_points(file, sensor, columns=columns, dtype=dtype, max_points=max_points)
            yield Sweep(points, matrix, time_us, str(file))

    return Drive(read(), posed=poses is not None, timed=poses is not None)


def _listed(files: list[Path], poses: Path) -> tuple[list[Path], list[int], list[np.ndarray]]:
    """The clouds in the order of a JSON list, with times and poses."""
    listed = read_entries(poses)
    known = {(poses.parent / entry.file).resolve(): entry for entry in listed}
    if len(known) < len(listed):
        raise ValueError(f"{poses}: got {len(listed)} entries for {len(known)} clouds, expected each once")
    by_place = {file.resolve(): file for file in files}
    for place, file in by_place.items():
        if place not in known:
            raise ValueError(f"{poses}: no pose of {file}, expected an entry for every cloud")
    entries = [(by_place[place], entry) for place, entry in known.items() if place in by_place]
    times = [entry.timestamp_us for _, entry in entries]
    return [file for file, _ in entries], times, [np.array(entry.sensor_to_world) for _, entry in entries]


def _posed(files: list[Path], path: Path) -> tuple[list[Path], list[int], list[np.ndarray]]:
    """The clouds in the order of time, with times and poses from a file of lines."""
    track = read_tum(path)
    times = [_time_of(file) for file in files]
    if any(time is None for time in times):
        if len(files) != len(track.times_us):
            raise ValueError(
                f"{path}: got {len(track.times_us)} poses for {len(files)} clouds, expected one a cloud, or "
                f"clouds whose names are times (seconds with a decimal point, or nanoseconds)"
            )
        for before, after in itertools.pairwise(files):
            if _in_parts(before.name) > _in_parts(after.name):
                raise ValueError(
                    f"{path}: poses are given to clouds in the order of their names: got {before.name} before "
                    f"{after.name}, expected numbers of one length, or FILE.json"
                )
        return files, track.times_us.tolist(), list(pose_matrix(track.rotations, track.translations))
    timed = sorted((time, file) for time, file in zip(times, files, strict=True) if time is not None)
    matrices = [track.at(time, f"{path}: {file}") for time, file in timed]
    return [file for _, file in timed], [time for time, _ in timed], matrices


def _in_parts(name: str) -> list[str | int]:
    """A name by which numbers of different lengths are sorted as numbers.

    >>> _in_parts("sweep_9.npy") < _in_parts("sweep_10.npy")
    True
    """
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def _time_of(file: Path) -> int | None:
    """Microseconds, where the name is a time.

    >>> _time_of(Path("12.5.bin")), _time_of(Path("1532402927647951000.npy")), _time_of(Path("000012.bin"))
    (12500000, 1532402927647951, None)
    """
    stem = file.name.lower().removesuffix(".bin").removesuffix(".pcd").removesuffix(file.suffix.lower())
    whole, point, part = stem.partition(".")
    if not (whole.isdecimal() and (part or "0").isdecimal()):
        return None
    if point:
        return round(Decimal(stem) * 1_000_000) if float(stem) < _LATEST_S else None
    return int(stem) // 1000 if len(stem) in _NANOSECOND_DIGITS else None


def read_tum(path: Path) -> PoseTrack:
    """Poses of a file of lines ``t x y z qx qy qz qw``; those that begin with # are left out.

    Raises:
        ValueError: naming the file, the line, what was found and what was expected.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file, expected poses")
    rows: list[list[float]] = []
    times: list[int] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time_s, *row = map(float, words)
        except ValueError:
            time_s, row = 0.0, []
        where = f"{path}: line {number}"
        if len(row) != 7 or not abs(time_s) < _LATEST_S:
            raise ValueError(f"{where}: got {line[:80]!r}, expected t x y z qx qy qz qw")
        time_us = round(Decimal(words[0]) * 1_000_000)  # a float has no microseconds of our days left
        if times and time_us <= times[-1]:
            raise ValueError(
                f"{where}: time: got {time_us / 1e6} s after {times[-1] / 1e6} s, expected a later one"
            )
        if bad := find_bad_pose(np.array([row[6:] + row[3:6]]), np.array([row[:3]])):
            raise ValueError(f"{where}: {bad[1]}")
        rows.append(row)
        times.append(time_us)
    if not rows:
        raise ValueError(f"{path}: no pose in it, expected lines t x y z qx qy qz qw")
    poses = np.array(rows)
    return PoseTrack(np.array(times), poses[:, [6, 3, 4, 5]], poses[:, :3])
