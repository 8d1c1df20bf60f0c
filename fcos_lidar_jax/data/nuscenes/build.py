"""Read, check and join the official tables to an index."""

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from fcos_lidar_jax.data.nuscenes import tables as kinds
from fcos_lidar_jax.data.nuscenes.index import Index
from fcos_lidar_jax.data.nuscenes.tables import R, Row, read_table
from fcos_lidar_jax.data.sweeps import GAP_US, check_poses

CHANNEL = "LIDAR_TOP"  # the only sensor that is kept

Report = Callable[[str, int], None]  # called with the file and the number of rows read so far

Columns = dict[str, np.ndarray]


class _Tables:
    def __init__(self, folder: Path, report: Report) -> None:
        self.folder, self.report = folder, report

    def pieces(self, kind: type[R]) -> Iterator[list[R]]:
        num_rows = 0
        for rows in read_table(self.folder, kind):
            num_rows += len(rows)
            self.report(kind.file, num_rows)
            yield rows

    def read(self, kind: type[R]) -> tuple[list[R], dict[str, int]]:
        """All rows, and token -> row number."""
        rows = [row for piece in self.pieces(kind) for row in piece]
        return rows, self.number(rows, {})

    def number(self, rows: list[R], numbers: dict[str, int]) -> dict[str, int]:
        for row in rows:
            if row.token in numbers:
                raise self.error(type(row), row.token, "token: occurs twice")
            numbers[row.token] = len(numbers)
        return numbers

    def find(self, numbers: dict[str, int], row: Row, field: str) -> int:
        """The number of the row to which a field's token refers."""
        return self.look_up(numbers, type(row), row.token, field, getattr(row, field))

    def look_up(self, numbers: dict[str, int], kind: type[Row], token: str, field: str, target: str) -> int:
        """The number of the row to which the token ``target`` refers; it is in a field of the row ``token``."""
        if target not in numbers:
            raise self.error(kind, token, f"{field}: got {target!r}, expected the token of an existing record")
        return numbers[target]

    def find_all(self, numbers: dict[str, int], rows: list[R], field: str, dtype: type) -> np.ndarray:
        return np.array([self.find(numbers, row, field) for row in rows], dtype)

    def normalise_poses(self, kind: type[Row], tokens: list[str], columns: Columns) -> None:
        """Refuse invalid poses, and normalise rotations to the last bit."""
        rotation = columns["rotation"]
        check_poses(rotation, columns["translation"], lambda row: self.place(kind, tokens[row]))
        columns["rotation"] = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)

    def place(self, kind: type[Row], token: str) -> str:
        return f"{self.folder / kind.file}: record {token}"

    def error(self, kind: type[Row], token: str, problem: str) -> ValueError:
        return ValueError(f"{self.place(kind, token)}: {problem}")


def _floats(rows: list[Any], **widths: int) -> Columns:
    columns = {field: np.array([getattr(row, field) for row in rows], np.float64) for field in widths}
    return {field: column.reshape(-1, widths[field]) for field, column in columns.items()}


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def build_index(folder: str | Path, report: Report = lambda name, rows: None) -> Index:
    """Read, check and join the tables in ``ROOT/VERSION``; ``report`` is called after every piece of a table."""
    tables = _Tables(Path(folder), report)
    columns = _keyframes(tables)
    samples = {token.decode(): i for i, token in enumerate(columns["sample_token"])}
    columns |= _sweeps(tables, samples)
    columns |= _boxes(tables, samples, columns["sample_time_us"])
    return Index(**columns)


def _keyframes(tables: _Tables) -> Columns:
    """Samples scene by scene, in temporal order."""
    scenes, scene_numbers = tables.read(kinds.Scene)
    samples, _ = tables.read(kinds.Sample)
    scene_of = tables.find_all(scene_numbers, samples, "scene_token", np.int32)
    times = np.array([sample.timestamp for sample in samples], np.int64)
    order = np.lexsort((times, scene_of))
    return {
        "scene_name": np.array([scene.name for scene in scenes], np.str_),
        "sample_token": np.array([samples[i].token.encode() for i in order], np.bytes_),
        "sample_time_us": times[order],
        "sample_scene": scene_of[order],
    }


def _sweeps(tables: _Tables, samples: dict[str, int]) -> Columns:
    """The LiDAR's sweeps with their poses, each linked to the sweep before it."""
    sensors, sensor_numbers = tables.read(kinds.SensorRow)
    mounts, mount_numbers = tables.read(kinds.CalibratedSensor)
    sensor_of = tables.find_all(sensor_numbers, mounts, "sensor_token", np.int32)
    mounts = [mount for mount, i in zip(mounts, sensor_of, strict=True) if sensors[i].channel == CHANNEL]
    lidars = {mount.token: i for i, mount in enumerate(mounts)}
    rows: list[kinds.SampleData] = []
    for piece in tables.pieces(kinds.SampleData):
        for row in piece:
            tables.find(mount_numbers, row, "calibrated_sensor_token")
            if row.calibrated_sensor_token in lidars:
                _check_path(tables, row)
                rows.append(row)
    numbers = tables.number(rows, {})
    times = np.array([row.timestamp for row in rows], np.int64)
    sample_of = tables.find_all(samples, rows, "sample_token", np.int64)
    previous = np.array([tables.find(numbers, row, "prev") if row.prev else -1 for row in rows], np.int32)
    for i in np.flatnonzero((previous >= 0) & (times[previous] >= times)):
        problem = f"prev: got {rows[i].prev!r}, expected an earlier sweep"
        raise tables.error(kinds.SampleData, rows[i].token, problem)
    gaps = (times - times[previous])[previous >= 0]
    if len(gaps) and not GAP_US[0] <= np.median(gaps) <= GAP_US[1]:
        found = f"{np.median(gaps):g} from sweep to sweep, expected microseconds, {GAP_US[0]} to {GAP_US[1]}"
        raise tables.error(kinds.SampleData, rows[0].token, f"timestamp: got {found}")
    key = np.array([row.is_key_frame for row in rows], bool)
    own_sweep = np.full(len(samples), -1, np.int32)
    own_sweep[sample_of[key]] = np.flatnonzero(key)
    if (own_sweep < 0).any():
        lost = list(samples)[int(np.argmin(own_sweep))]
        problem = f"token: no keyframe of {CHANNEL} in {kinds.SampleData.file} refers to it"
        raise tables.error(kinds.Sample, lost, problem)
    ego = _ego_poses(tables, rows)
    mounted = _floats(mounts, rotation=4, translation=3)
    tables.normalise_poses(kinds.CalibratedSensor, list(lidars), mounted)
    return {
        "sample_sweep": own_sweep,
        "sweep_file": np.array([row.filename.encode() for row in rows], np.bytes_),
        "sweep_time_us": times,
        "sweep_previous": previous,
        "sweep_sensor": np.array([lidars[row.calibrated_sensor_token] for row in rows], np.int32),
        **{f"ego_{name}": column for name, column in ego.items()},
        **{f"sensor_{name}": column for name, column in mounted.items()},
    }


def _check_path(tables: _Tables, row: kinds.SampleData) -> None:
    path = PurePosixPath(row.filename)
    if path.is_absolute() or ".." in path.parts or not path.parts or "\\" in row.filename:
        problem = f"filename: got {row.filename!r}, expected a path below the root"
        raise tables.error(kinds.SampleData, row.token, problem)


def _ego_poses(tables: _Tables, rows: list[kinds.SampleData]) -> Columns:
    """The poses of the LiDAR's sweeps; poses of other sensors are skipped."""
    wanted = {row.ego_pose_token for row in rows}
    parts, numbers = list[Columns](), dict[str, int]()
    for piece in tables.pieces(kinds.EgoPose):
        poses = [pose for pose in piece if pose.token in wanted]
        tables.number(poses, numbers)
        parts.append(_floats(poses, rotation=4, translation=3))
    columns = _joined(parts)
    tables.normalise_poses(kinds.EgoPose, list(numbers), columns)
    order = tables.find_all(numbers, rows, "ego_pose_token", np.int64)
    return {name: column[order] for name, column in columns.items()}


def _boxes(tables: _Tables, samples: dict[str, int], sample_time_us: np.ndarray) -> Columns:
    """Annotations with velocities, in the order of their samples."""
    categories, category_numbers = tables.read(kinds.Category)
    attributes, attribute_numbers = tables.read(kinds.Attribute)
    instances, instance_numbers = tables.read(kinds.Instance)
    category_of = tables.find_all(category_numbers, instances, "category_token", np.int16)
    parts, numbers = list[Columns](), dict[str, int]()
    links: dict[str, list[str]] = {"prev": [], "next": []}

    def attribute_of(row: kinds.SampleAnnotation) -> int:
        if not row.attribute_tokens:
            return -1
        first = row.attribute_tokens[0]
        return tables.look_up(attribute_numbers, type(row), row.token, "attribute_tokens", first)

    for piece in tables.pieces(kinds.SampleAnnotation):
        tables.number(piece, numbers)
        for field, tokens in links.items():
            tokens.extend(getattr(row, field) for row in piece)
        parts.append(
            {
                "token": np.array([row.token.encode() for row in piece], np.bytes_),
                "sample": tables.find_all(samples, piece, "sample_token", np.int64),
                "instance": tables.find_all(instance_numbers, piece, "instance_token", np.int32),
                "attribute": np.array([attribute_of(row) for row in piece], np.int16),
                **_floats(piece, translation=3, size=3, rotation=4),
                "lidar_points": np.array([row.num_lidar_pts for row in piece], np.int32),
                "radar_points": np.array([row.num_radar_pts for row in piece], np.int32),
            }
        )
    columns, tokens = _joined(parts), list(numbers)
    tables.normalise_poses(kinds.SampleAnnotation, tokens, columns)

    def neighbour(own: str, field: str, other: str) -> int:
        return tables.look_up(numbers, kinds.SampleAnnotation, own, field, other) if other else -1

    neighbours = [
        np.array([neighbour(own, field, other) for own, other in zip(tokens, linked, strict=True)], np.int64)
        for field, linked in links.items()
    ]
    sample = columns.pop("sample")
    columns["velocity"] = velocities(columns["translation"], sample_time_us[sample], *neighbours)
    order = np.argsort(sample, kind="stable")
    return {
        "category_name": np.array([row.name for row in categories], np.str_),
        "attribute_name": np.array([row.name for row in attributes], np.str_),
        "sample_first": np.searchsorted(sample[order], np.arange(len(samples) + 1)),
        "box_category": category_of[columns["instance"]][order],
        **{f"box_{name}": column[order] for name, column in columns.items()},
    }


def velocities(translation: np.ndarray, time_us: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Velocity of every annotation from its neighbours in time, f64[n, 3] in m/s, NaN if unknown.

    The central difference between two neighbours at most 3 s apart, or the one-sided difference to a single
    neighbour at most 1.5 s away; otherwise unknown.

    Args:
        translation: f64[n, 3], metres.
        time_us: i64[n].
        before, after: row of the same object's annotation before and after, -1 if there is none.

    >>> where, when = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([0, 500_000])
    >>> velocities(where, when, np.array([-1, 0]), np.array([1, -1]))[:, 0].tolist()
    [2.0, 2.0]
    """
    own = np.arange(len(translation))
    first, last = np.where(before < 0, own, before), np.where(after < 0, own, after)
    # The official rounding, 0.2 microseconds off: the benchmark's velocity errors depend on it.
    seconds = 1e-6 * time_us[last] - 1e-6 * time_us[first]
    longest = np.where((before >= 0) & (after >= 0), 3.0, 1.5)
    known = (seconds > 0) & (seconds <= longest)
    moved = translation[last] - translation[first]
    return np.where(known[:, None], moved / np.where(known, seconds, 1.0)[:, None], np.nan)
