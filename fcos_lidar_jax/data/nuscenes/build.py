"""From the official tables to an index: read, check, join."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from fcos_lidar_jax.data.box_geometry import LIMITS
from fcos_lidar_jax.data.nuscenes.index import Index
from fcos_lidar_jax.data.nuscenes.tables import (
    Attribute,
    CalibratedSensor,
    Category,
    EgoPose,
    Instance,
    Row,
    Sample,
    SampleAnnotation,
    SampleData,
    Scene,
    SensorRow,
    TableError,
    read_table,
    table_file,
)
from fcos_lidar_jax.data.sweeps import FARTHEST_M

CHANNEL = "LIDAR_TOP"
"""The one sensor that is kept."""

_METRES = f"finite numbers of at most {FARTHEST_M:g} m"

Report = Callable[[str, int], None]
"""Told which file is being read and how many of its rows have been."""

R = TypeVar("R", bound=Row)


class _Tables:
    """Access to the tables of one folder, with the checks that all of them share."""

    def __init__(self, folder: Path, report: Report) -> None:
        self.folder, self.report = folder, report

    def pieces(self, kind: type[R]) -> Iterator[list[R]]:
        seen = 0
        for rows in read_table(self.folder, kind):
            seen += len(rows)
            self.report(table_file(kind), seen)
            yield rows

    def all(self, kind: type[R]) -> list[R]:
        return [row for rows in self.pieces(kind) for row in rows]

    def fail(self, kind: type[Row], token: str | bytes, field: str, problem: str) -> TableError:
        name = token.decode() if isinstance(token, bytes) else token
        return TableError(f"{self.folder / table_file(kind)}: record {name}: {field}: {problem}")

    def number(self, kind: type[Row], tokens: Iterable[str], rows: dict[str, int] | None = None) -> dict[str, int]:
        """Token -> row, going on from what is there."""
        rows = {} if rows is None else rows
        for token in tokens:
            if token in rows:
                raise self.fail(kind, token, "token", "occurs twice")
            rows[token] = len(rows)
        return rows

    def find(self, rows: dict[str, int], token: str, kind: type[Row], record: str, field: str) -> int:
        """The row that a token refers to."""
        row = rows.get(token)
        if row is None:
            raise self.fail(kind, record, field, f"got {token!r}, expected the token of an existing record")
        return row

    def check_poses(
        self,
        kind: type[Row],
        tokens: Sequence[str | bytes] | np.ndarray,
        rotation: np.ndarray,
        translation: np.ndarray,
    ) -> np.ndarray:
        """Finite translations and rotations of norm one, normalised to the last bit."""
        norm = np.linalg.norm(rotation, axis=1)
        checks = (
            ("translation", translation, (np.abs(translation) <= FARTHEST_M).all(axis=1), _METRES),
            ("rotation", rotation, np.abs(norm - 1) < 1e-3, "a unit quaternion w, x, y, z"),
        )
        for field, values, good, expected in checks:
            if not good.all():
                row = int(np.argmin(good))
                raise self.fail(kind, tokens[row], field, f"got {values[row].tolist()}, expected {expected}")
        return rotation / norm[:, None]


def _rows(rows: list[R], width: int, pick: Callable[[R], tuple[float, ...]]) -> np.ndarray:
    return np.array([pick(row) for row in rows], np.float64).reshape(-1, width)


def build_index(folder: str | Path, report: Report = lambda name, rows: None) -> Index:
    """Read, check and join the tables of one version.

    Args:
        folder: ``ROOT/VERSION``.
        report: called after every piece of a table.

    Raises:
        TableError: naming the file, the record, the field, what was found and what was expected.
    """
    tables = _Tables(Path(folder), report)
    if not tables.folder.is_dir():
        raise TableError(f"{folder}: no such folder, expected the tables of a version")
    scenes, samples = tables.all(Scene), tables.all(Sample)
    columns = _keyframes(tables, scenes, samples)
    order = {token.decode(): i for i, token in enumerate(columns["sample_token"])}
    columns |= _sweeps(tables, order)
    columns |= _boxes(tables, order, columns["sample_time_us"])
    return Index(**columns)


def _keyframes(tables: _Tables, scenes: list[Scene], samples: list[Sample]) -> dict[str, np.ndarray]:
    """Samples scene by scene, in the order of time."""
    scene_row = tables.number(Scene, (scene.token for scene in scenes))
    tables.number(Sample, (sample.token for sample in samples))
    scene_of = [tables.find(scene_row, s.scene_token, Sample, s.token, "scene_token") for s in samples]
    times = np.array([s.timestamp for s in samples], np.int64)
    order = np.lexsort((times, np.array(scene_of, np.int64)))
    return {
        "scene_name": np.array([scene.name for scene in scenes], np.str_),
        "sample_token": np.array([samples[i].token for i in order], np.bytes_),
        "sample_time_us": times[order],
        "sample_scene": np.array(scene_of, np.int32)[order],
    }


def _sweeps(tables: _Tables, sample_row: dict[str, int]) -> dict[str, np.ndarray]:
    """The LiDAR's files with their poses, chained."""
    channel = {row.token: row.channel for row in tables.all(SensorRow)}
    mounted = tables.all(CalibratedSensor)
    for row in mounted:
        if row.sensor_token not in channel:
            raise tables.fail(
                CalibratedSensor, row.token, "sensor_token", f"got {row.sensor_token!r}, expected a sensor's token"
            )
    known = {row.token for row in mounted}
    mounted = [row for row in mounted if channel[row.sensor_token] == CHANNEL]
    sensor_row = tables.number(CalibratedSensor, (row.token for row in mounted))
    rows: list[SampleData] = []
    for piece in tables.pieces(SampleData):
        for row in piece:
            if row.calibrated_sensor_token in sensor_row:
                rows.append(row)
            elif row.calibrated_sensor_token not in known:
                tables.find(
                    sensor_row, row.calibrated_sensor_token, SampleData, row.token, "calibrated_sensor_token"
                )
    row_of = tables.number(SampleData, (row.token for row in rows))
    times = np.array([row.timestamp for row in rows], np.int64)
    previous = np.full(len(rows), -1, np.int32)
    own_sweep = np.full(len(sample_row), -1, np.int32)
    for i, row in enumerate(rows):
        _check_path(tables, row)
        if row.prev:
            previous[i] = tables.find(row_of, row.prev, SampleData, row.token, "prev")
            if times[previous[i]] >= times[i]:
                raise tables.fail(SampleData, row.token, "prev", f"got {row.prev!r}, expected an earlier sweep")
        sample = tables.find(sample_row, row.sample_token, SampleData, row.token, "sample_token")
        if row.is_key_frame:
            own_sweep[sample] = i
    tokens = list(sample_row)
    if (own_sweep < 0).any():
        lost = tokens[int(np.argmin(own_sweep))]
        raise tables.fail(Sample, lost, "token", f"no keyframe of {CHANNEL} in sample_data.json refers to it")
    ego_rotation, ego_translation = _ego_poses(tables, rows)
    sensor_rotation = _rows(mounted, 4, lambda r: r.rotation)
    sensor_translation = _rows(mounted, 3, lambda r: r.translation)
    sensor_rotation = tables.check_poses(
        CalibratedSensor, [r.token for r in mounted], sensor_rotation, sensor_translation
    )
    return {
        "sample_sweep": own_sweep,
        "sweep_file": np.array([row.filename.encode() for row in rows], np.bytes_),
        "sweep_time_us": times,
        "sweep_previous": previous,
        "sweep_sensor": np.array([sensor_row[row.calibrated_sensor_token] for row in rows], np.int32),
        "ego_rotation": ego_rotation,
        "ego_translation": ego_translation,
        "sensor_rotation": sensor_rotation,
        "sensor_translation": sensor_translation,
    }


def _check_path(tables: _Tables, row: SampleData) -> None:
    path = PurePosixPath(row.filename)
    if path.is_absolute() or ".." in path.parts or not path.parts or "\\" in row.filename:
        raise tables.fail(
            SampleData, row.token, "filename", f"got {row.filename!r}, expected a path below the root"
        )


def _ego_poses(tables: _Tables, rows: list[SampleData]) -> tuple[np.ndarray, np.ndarray]:
    """The poses of the sweeps; those of the other sensors are skipped."""
    users: dict[str, list[int]] = {}
    for i, row in enumerate(rows):
        users.setdefault(row.ego_pose_token, []).append(i)
    rotation, translation = np.full((len(rows), 4), np.nan), np.full((len(rows), 3), np.nan)
    found = np.zeros(len(rows), bool)
    for piece in tables.pieces(EgoPose):
        for pose in piece:
            for i in users.get(pose.token, ()):
                rotation[i], translation[i], found[i] = pose.rotation, pose.translation, True
    if not found.all():
        lost = rows[int(np.argmin(found))]
        raise tables.fail(
            SampleData,
            lost.token,
            "ego_pose_token",
            f"got {lost.ego_pose_token!r}, expected the token of an existing record",
        )
    return tables.check_poses(EgoPose, [row.ego_pose_token for row in rows], rotation, translation), translation


def _boxes(tables: _Tables, sample_row: dict[str, int], sample_time_us: np.ndarray) -> dict[str, np.ndarray]:
    """Annotations in the order of their samples, with velocities."""
    categories, attributes = tables.all(Category), tables.all(Attribute)
    category_row = tables.number(Category, (row.token for row in categories))
    attribute_row = tables.number(Attribute, (row.token for row in attributes))
    instances = tables.all(Instance)
    instance_row = tables.number(Instance, (row.token for row in instances))
    category_of = np.array(
        [tables.find(category_row, r.category_token, Instance, r.token, "category_token") for r in instances],
        np.int16,
    )
    parts: dict[str, list[np.ndarray]] = {}
    row_of: dict[str, int] = {}
    links: tuple[list[str], list[str]] = ([], [])

    def refer(rows: dict[str, int], row: SampleAnnotation, field: str, token: str) -> int:
        return tables.find(rows, token, SampleAnnotation, row.token, field)

    def attribute_of(row: SampleAnnotation) -> int:
        if not row.attribute_tokens:
            return -1
        return refer(attribute_row, row, "attribute_tokens", row.attribute_tokens[0])

    for piece in tables.pieces(SampleAnnotation):
        tables.number(SampleAnnotation, (row.token for row in piece), row_of)
        links[0].extend(row.prev for row in piece)
        links[1].extend(row.next for row in piece)
        new = {
            "token": np.array([row.token.encode() for row in piece], np.bytes_),
            "sample": np.array([refer(sample_row, r, "sample_token", r.sample_token) for r in piece], np.int64),
            "instance": np.array(
                [refer(instance_row, r, "instance_token", r.instance_token) for r in piece], np.int32
            ),
            "attribute": np.array(
                [
                    refer(attribute_row, r, "attribute_tokens", r.attribute_tokens[0])
                    if r.attribute_tokens
                    else -1
                    for r in piece
                ],
                np.int16,
            ),
            "translation": _rows(piece, 3, lambda r: r.translation),
            "size": _rows(piece, 3, lambda r: r.size),
            "rotation": _rows(piece, 4, lambda r: r.rotation),
            "lidar_points": np.array([row.num_lidar_pts for row in piece], np.int32),
            "radar_points": np.array([row.num_radar_pts for row in piece], np.int32),
        }
        for name, column in new.items():
            parts.setdefault(name, []).append(column)
    columns = {name: np.concatenate(column) for name, column in parts.items()}
    _check_boxes(tables, columns)
    before, after = (
        np.array(
            [
                tables.find(row_of, token, SampleAnnotation, row, field) if token else -1
                for token, row in zip(tokens, row_of, strict=True)
            ],
            np.int64,
        )
        for tokens, field in zip(links, ("prev", "next"), strict=True)
    )
    time_us = sample_time_us[columns["sample"]] if row_of else np.zeros(0, np.int64)
    columns["velocity"] = velocities(columns["translation"], time_us, before, after)
    sample = columns.pop("sample")
    order = np.argsort(sample, kind="stable")
    return {
        "category_name": np.array([row.name for row in categories], np.str_),
        "attribute_name": np.array([row.name for row in attributes], np.str_),
        "sample_first": np.searchsorted(sample[order], np.arange(len(sample_row) + 1)),
        "box_category": category_of[columns["instance"]][order],
        **{f"box_{name}": column[order] for name, column in columns.items()},
    }


def _check_boxes(tables: _Tables, columns: dict[str, np.ndarray]) -> None:
    size, tokens = columns["size"], columns["token"]
    good = ((size <= LIMITS["l"]) & (size > 0)).all(axis=1)
    if not good.all():
        row = int(np.argmin(good))
        expected = f"three positive lengths of at most {LIMITS['l']:g} m"
        raise tables.fail(SampleAnnotation, tokens[row], "size", f"got {size[row].tolist()}, expected {expected}")
    columns["rotation"] = tables.check_poses(SampleAnnotation, tokens, columns["rotation"], columns["translation"])


def velocities(translation: np.ndarray, time_us: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Velocity of every annotation from its neighbours in time.

    The central difference where there are two neighbours at most 3 s apart, the one-sided where there is one at
    most 1.5 s away, else unknown.

    Args:
        translation: f64[n, 3], metres.
        time_us: i64[n].
        before: row of the same object's annotation before, -1 for none.
        after: likewise after.

    Returns:
        f64[n, 3] in m/s, NaN where unknown.

    >>> where, when = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([0, 500_000])
    >>> velocities(where, when, np.array([-1, 0]), np.array([1, -1]))[:, 0].tolist()
    [2.0, 2.0]
    """
    own = np.arange(len(translation))
    first, last = np.where(before < 0, own, before), np.where(after < 0, own, after)
    # The official rounding, 0.2 microseconds off: the benchmark's velocity errors hang on it.
    seconds = 1e-6 * time_us[last] - 1e-6 * time_us[first]
    longest = np.where((before >= 0) & (after >= 0), 3.0, 1.5)
    known = (seconds > 0) & (seconds <= longest)
    moved = translation[last] - translation[first]
    return np.where(known[:, None], moved / np.where(known, seconds, 1.0)[:, None], np.nan)
