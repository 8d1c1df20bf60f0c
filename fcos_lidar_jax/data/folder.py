"""The user's own annotated clouds: a folder of point files with boxes in JSON beside them."""

import dataclasses
import os
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data import point_files
from fcos_lidar_jax.data.box_geometry import LIMITS, count_inside, find_bad_box
from fcos_lidar_jax.data.class_mapping import unknown_name
from fcos_lidar_jax.data.frame import (
    Frame,
    FrameSet,
    distinct_names,
    drop_close,
    files_fingerprint,
    without_points,
)
from fcos_lidar_jax.data.sweeps import ListedSweep, read_list, read_sweeps
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.sensors import PRESETS, Sensor, sensor_from_json

_SPLITS = "splits.json"
_MAX_LAGS = 100  # Nobody fuses as many sweeps.
_Speed = Annotated[float, msgspec.Meta(ge=-LIMITS["vx"], le=LIMITS["vx"])]  # no NaN: an unknown one is null


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    """One box, in the shape that ``fcos-lidar detect`` writes."""

    label: str
    box: tuple[float, float, float, float, float, float, float, _Speed | None, _Speed | None]
    score: float | None = None  # a detector's; a corrected prediction may keep it


class _Annotation(msgspec.Struct, forbid_unknown_fields=True):
    boxes: list[_Record]


class FolderFrames(FrameSet):
    """The frames of a folder, sorted by name: a :class:`~fcos_lidar_jax.data.frame.FrameSet`.

    ``sensor.json`` is a sensor as :func:`~fcos_lidar_jax.sensors.sensor_from_json` reads it, or a preset's name.
    ``clouds/NAME.EXT`` is any file that :func:`~fcos_lidar_jax.data.point_files.read_points` reads.
    ``boxes/NAME.json`` is ``{"boxes": [{"label": CLASS, "box": [x, y, z, l, w, h, yaw, vx, vy]}]}`` in the frame
    of the points, an unknown velocity ``null, null``; a frame without objects has an empty list.
    ``sweeps/NAME.json``, optional, is a list as :func:`~fcos_lidar_jax.data.sweeps.read_sweeps` reads it, its
    first entry the frame's own cloud. No file may lie outside the folder, links included.

    The classes are the labels of all boxes, sorted, unless there is a ``classes.json``: a list of them
    (``["car", "sign"]``; other labels are refused), or a translation of labels, null for boxes to leave out
    (``{"lorry": "truck", "sign": null}``; the classes are then the labels after it, sorted). ``splits.json``,
    optional, is ``{"train": [NAME, ...], "val": [...]}``.

    The names of all files are checked at construction, and their boxes read where the classes follow from them;
    other contents when a frame is asked for.

    Args:
        root: the folder.
        sensor: whose points they are; replaces ``sensor.json``.
        split: frames and order from the splits; all frames, sorted, without it.
        splits: JSON file with them; default: ``splits.json``.
        reading: clouds to fuse at most, from the first of the list on, and which points are dropped.
        follow_links: read files that lie outside the folder.

    Raises:
        ValueError: here or on reading a frame, naming the file, the field, what was found and what was expected.

    >>> import json, tempfile
    >>> root = Path(tempfile.mkdtemp())
    >>> for name in ("clouds", "boxes"):
    ...     (root / name).mkdir()
    >>> _ = (root / "sensor.json").write_text('"tiny"')
    >>> np.save(root / "clouds" / "a.npy", np.array([[8, 1, -1, 30], [9, 4, -1, 30.0]]))
    >>> box = {"label": "car", "box": [8, 1, -1, 4, 2, 1.5, 0, None, None]}
    >>> _ = (root / "boxes" / "a.json").write_text(json.dumps({"boxes": [box]}))
    >>> frames = FolderFrames(root)
    >>> frames.classes, frames.labels(0).tolist(), frames.frame(0).num_points.tolist()
    (('car',), [0], [1])
    """

    def __init__(
        self,
        root: str | Path,
        sensor: Sensor | None = None,
        *,
        split: str | None = None,
        splits: str | Path | None = None,
        reading: CloudReading = CloudReading(),
        follow_links: bool = False,
    ) -> None:
        self.root = root = Path(root)
        self._inside = None if follow_links else root
        self.reading = reading
        self._clouds = _list_files(root, "clouds", point_files.ENDINGS, self._inside)
        self._boxes = _list_files(root, "boxes", (".json",), self._inside)
        listed = (root / "sweeps").exists()
        self._sweeps = _list_files(root, "sweeps", (".json",), self._inside) if listed else {}
        if not self._clouds:
            raise ValueError(f"{root / 'clouds'}: no point file in it, expected at least one")
        for files in (self._boxes, self._sweeps):
            for name in sorted(files.keys() - self._clouds.keys()):
                raise ValueError(f"{files[name]}: no cloud named {name} in {root / 'clouds'}, expected one")
        for name in sorted(self._clouds.keys() - self._boxes.keys()):
            expected = 'one for every cloud, {"boxes": []} where there is no object'
            raise ValueError(f"{self._clouds[name]}: no {root / 'boxes' / name}.json, expected {expected}")
        self.names = tuple(sorted(self._clouds))
        """Names of the frames: of their files, without the extension."""
        self.sensor = _read_sensor(root, self._inside) if sensor is None else sensor
        self.classes, self._translation = self._read_classes()
        if split is not None:
            self.names = _read_split(root / _SPLITS if splits is None else Path(splits), split, self._clouds)

    def __len__(self) -> int:
        return len(self.names)

    def frame(self, index: int) -> Frame:
        """One frame, read anew; the points in each box are counted."""
        return self._frame(index, self.reading)

    def truth(self, index: int) -> Frame:
        """As of any frame set; of the sweeps the current one alone is read, for its points in each box count."""
        return without_points(self._frame(index, dataclasses.replace(self.reading, num_sweeps=1)))

    def labels(self, index: int) -> np.ndarray:
        return self._annotation(index)[1]

    def name(self, index: int) -> str:
        return self.names[index]

    def pose(self, index: int) -> np.ndarray | None:
        """Of the list of sweeps, where the frame has one."""
        current = self._current_sweep(index)
        return None if current is None else np.array(current.sensor_to_world)

    def time_us(self, index: int) -> int | None:
        """Of the list of sweeps, where the frame has one."""
        current = self._current_sweep(index)
        return None if current is None else current.timestamp_us

    def fingerprint(self) -> str:
        listed = (file.parent / sweep.file for file in self._sweeps.values() for sweep in read_list(file))
        older = {*map(_normalized, listed)} - {*map(_normalized, self._clouds.values())}
        files = [*self._clouds.values(), *self._boxes.values(), *self._sweeps.values(), *older]
        files += [file for name in ("sensor.json", "classes.json") if (file := self.root / name).exists()]
        reading = self.names, self.sensor, *dataclasses.astuple(self.reading)
        return files_fingerprint(files, self.root, reading)

    def _current_sweep(self, index: int) -> ListedSweep | None:
        listed = self._sweeps.get(self.names[index])
        return None if listed is None else read_list(listed)[0]

    def _frame(self, index: int, reading: CloudReading) -> Frame:
        boxes, labels = self._annotation(index)
        points, num_close = self._points(index, reading)
        return Frame(points, boxes, labels, count_inside(points[points[:, 4] == 0], boxes), num_close)

    def _points(self, index: int, reading: CloudReading) -> tuple[np.ndarray, int]:
        cloud, listed = self._clouds[self.names[index]], self._sweeps.get(self.names[index])
        if listed is None or self.reading.num_sweeps == 1:
            points = point_files.read_points(cloud, self.sensor)
            _expect_sweeps(points[:, 4], cloud)
            return drop_close(points, self.sensor, reading)
        files = [sweep.file for sweep in read_list(listed)]
        for i, file in enumerate(files):
            _expect_file(listed.parent / file, self._inside, f"{listed}: $[{i}].file")
        if (listed.parent / files[0]).resolve() != cloud.resolve():
            expected = f"the frame's own cloud, '../clouds/{cloud.name}'"
            raise ValueError(f"{listed}: $[0].file: got {files[0]!r}, expected {expected}")
        return read_sweeps(listed, self.sensor, reading)

    def _annotation(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        file = self._boxes[self.names[index]]
        records = read_json(file, _Annotation).boxes
        boxes = np.array([record.box for record in records], np.float64).reshape(-1, 9)  # null becomes NaN
        if (bad := find_bad_box(boxes)) is not None:
            raise ValueError(f"{file}: $.boxes[{bad[0]}].box: {bad[1]}")
        kept, labels = [], []
        for i, record in enumerate(records):
            label = self._translation.get(record.label, record.label)
            if label is not None and label not in self.classes:
                raise ValueError(f"{file}: $.boxes[{i}].label: {unknown_name(label, self.classes)}")
            if label is not None:
                kept.append(i)
                labels.append(self.classes.index(label))
        boxes = boxes[kept]
        boxes[:, 6] = wrap_angle(boxes[:, 6])
        return boxes.astype(np.float32), np.array(labels, np.int32)

    def _read_classes(self) -> tuple[tuple[str, ...], dict[str, str | None]]:
        """The classes, and what labels in the files become, None for boxes to leave out."""
        file = self.root / "classes.json"
        own: list[str] | dict[str, str | None] = {}
        if os.path.lexists(file):
            _expect_file(file, self._inside, str(file))
            own = read_json(file, list[str] | dict[str, str | None])
        if isinstance(own, list):
            if not own or len(set(own)) < len(own):
                raise ValueError(f"{file}: got {len(own)} names, expected at least one, each once")
            return tuple(own), {}
        found = {own.get(r.label, r.label) for f in self._boxes.values() for r in read_json(f, _Annotation).boxes}
        return tuple(sorted(name for name in found if name is not None)), own


def _expect_sweeps(lags: np.ndarray, cloud: Path) -> None:
    """Refuse the offsets of single points in a turn: points with a time lag are of older sweeps."""
    different = len(np.unique(lags[np.isfinite(lags)]))
    if different > _MAX_LAGS:
        found = f"got {different} different time lags, which look like offsets within a turn"
        raise ValueError(f"{cloud}: fifth column: {found}, expected one a sweep, 0 for the current one")


def _list_files(root: Path, folder: str, endings: tuple[str, ...], inside: Path | None) -> dict[str, Path]:
    """Name without extension -> file; hidden files are left out."""
    if not (root / folder).is_dir():
        raise ValueError(f"{root / folder}: no such folder, expected one with {', '.join(endings)} files")
    files: dict[str, Path] = {}
    for file in sorted((root / folder).iterdir()):
        if file.name.startswith("."):
            continue
        ending = next((e for e in endings if file.name.lower().endswith(e)), None)
        if ending is None:
            raise ValueError(f"{file}: unknown extension {file.suffix!r}, expected {', '.join(endings)}")
        _expect_file(file, inside, str(file))
        name = file.name[: -len(ending)]
        if name in files:
            raise ValueError(f"{file}: a second file named {name} beside {files[name].name}, expected one")
        files[name] = file
    return files


def _normalized(file: Path) -> Path:
    return Path(os.path.normpath(file))


def _expect_file(file: Path, inside: Path | None, where: str) -> None:
    """Refuse a file that is not there, or that a link or ``..`` takes out of a folder, if one is given."""
    if not os.path.isfile(file):
        raise ValueError(f"{where}: no such file" + ("" if where == str(file) else f": {file}"))
    real = os.path.realpath(file)
    if inside is not None and not Path(real).is_relative_to(os.path.realpath(inside)):
        found = f"resolves to {real}, expected a file inside {inside}"
        raise ValueError(f"{where}: {found}; --follow-links allows links that lead out")


def _read_sensor(root: Path, inside: Path | None) -> Sensor:
    file = root / "sensor.json"
    _expect_file(file, inside, str(file))
    record = read_json(file, str | dict[str, Any])
    if isinstance(record, dict):
        return sensor_from_json(record, str(file))
    if record not in PRESETS:
        raise ValueError(f"{file}: {unknown_name(record, PRESETS)}")
    return PRESETS[record]


def find_folder_splits(root: Path, file: str | Path | None = None) -> list[str]:
    """Names of the splits in a file, by default ``splits.json``; none where there is no such file."""
    own = root / _SPLITS
    return list(_read_splits(Path(file or own))) if file is not None or own.exists() else []


def _read_splits(file: Path) -> dict[str, list[str]]:
    """Name -> frames."""
    return read_json(file, dict[str, list[str]], what="splits")


def _read_split(file: Path, split: str, clouds: Collection[str]) -> tuple[str, ...]:
    splits = _read_splits(file)
    if split not in splits:
        raise ValueError(f"{file}: split: {unknown_name(split, splits)}")
    where = f"{file}: {split}"
    return distinct_names(((f"{where}[{i}]", name) for i, name in enumerate(splits[split])), clouds, where)
