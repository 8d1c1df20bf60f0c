"""Your own annotated clouds: a folder of point files with boxes in JSON files."""

import dataclasses
import os
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data import point_files
from fcos_lidar_jax.data.box_geometry import LIMITS, check_boxes, count_inside
from fcos_lidar_jax.data.frame import Frame, FrameSet, drop_close, files_fingerprint, without_points
from fcos_lidar_jax.data.splits import SPLITS, distinct_names, own_splits
from fcos_lidar_jax.data.sweeps import ListedSweep, read_list, read_sweeps
from fcos_lidar_jax.fields import check, check_name
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor, load_sensor

_SENSOR, _CLASSES = "sensor.json", "classes.json"
_CLOUDS, _BOXES, _SWEEPS = "clouds", "boxes", "sweeps"
_Speed = Annotated[float, msgspec.Meta(ge=-LIMITS["vx"], le=LIMITS["vx"])]  # no NaN: unknown speeds are null


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    """One box, as ``fcos-lidar detect`` writes it."""

    label: str
    box: tuple[float, float, float, float, float, float, float, _Speed | None, _Speed | None]
    score: float | None = None  # ignored; a corrected prediction may keep its score


class _Annotation(msgspec.Struct, forbid_unknown_fields=True):
    boxes: list[_Record]


class FolderFrames(FrameSet):
    """The frames of a folder, sorted by name: a :class:`~fcos_lidar_jax.data.frame.FrameSet`.

    ``docs/own_data.md`` describes the files. The first entry of ``sweeps/NAME.json``, a list for
    :func:`~fcos_lidar_jax.data.sweeps.read_sweeps`, is the frame's own cloud. Labels that a list of classes lacks
    are refused, and so are files outside the folder, even through a link, unless ``follow_links``.

    Args:
        sensor: replaces ``sensor.json``.
        split: take the frames and their order from a split; default: all frames, sorted.
        splits: JSON file with the splits; default: ``splits.json``.
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
        self._clouds = _list_files(root, _CLOUDS, point_files.ENDINGS, self._inside)
        self._boxes = _list_files(root, _BOXES, (".json",), self._inside)
        listed = (root / _SWEEPS).exists()
        self._sweeps = _list_files(root, _SWEEPS, (".json",), self._inside) if listed else {}
        for files in (self._boxes, self._sweeps):
            for name in sorted(files.keys() - self._clouds.keys()):
                raise ValueError(f"{files[name]}: no cloud named {name} in {root / _CLOUDS}, expected one")
        for name in sorted(self._clouds.keys() - self._boxes.keys()):
            expected = 'one for every cloud, {"boxes": []} where there is no object'
            raise ValueError(f"{self._clouds[name]}: no {root / _BOXES / name}.json, expected {expected}")
        self.names = tuple(sorted(self._clouds))
        """Names of the frames: file names without extension."""
        for name in (_SENSOR, _CLASSES):
            point_files.check_inside(root / name, self._inside, str(root / name))
        self.sensor = load_sensor(root / _SENSOR) if sensor is None else sensor
        self.classes, self._translation = self._read_classes()
        if split is not None:
            self.names = _read_split(root, splits, split, self._clouds)

    def __len__(self) -> int:
        return len(self.names)

    def frame(self, index: int) -> Frame:
        """Read one frame and count the points in each box."""
        return self._frame(index, self.reading)

    def truth(self, index: int) -> Frame:
        """:meth:`frame` without its points; reads only the current sweep, to count its points in each box."""
        return without_points(self._frame(index, dataclasses.replace(self.reading, num_sweeps=1)))

    def labels(self, index: int) -> np.ndarray:
        return self._annotation(index)[1]

    def name(self, index: int) -> str:
        return self.names[index]

    def pose(self, index: int) -> np.ndarray | None:
        current = self._current_sweep(index)
        return None if current is None else np.array(current.sensor_to_world)

    def time_us(self, index: int) -> int | None:
        current = self._current_sweep(index)
        return None if current is None else current.timestamp_us

    def check_files(self, indices: Iterable[int]) -> None:
        names = [self.names[index] for index in indices if self.reading.num_sweeps > 1]
        for cloud, listed in ((self._clouds[name], self._sweeps[name]) for name in names if name in self._sweeps):
            files = [sweep.file for sweep in read_list(listed)]
            for i, file in enumerate(files):
                _expect_file(listed.parent / file, self._inside, f"{listed}: $[{i}].file")
            is_own = (listed.parent / files[0]).resolve() == cloud.resolve()
            check(is_own, f"{listed}: $[0].file", files[0], f"the frame's own cloud, '../clouds/{cloud.name}'")

    def fingerprint(self) -> str:
        listed = (file.parent / sweep.file for file in self._sweeps.values() for sweep in read_list(file))
        clouds = {os.path.normpath(file) for file in self._clouds.values()}
        older = {Path(path) for path in map(os.path.normpath, listed) if path not in clouds}
        files = [*self._clouds.values(), *self._boxes.values(), *self._sweeps.values(), *older]
        files += [file for name in (_SENSOR, _CLASSES) if (file := self.root / name).exists()]
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
            points = point_files.read_points(cloud, self.sensor, num_sweeps=self.reading.num_sweeps)
            return drop_close(points, self.sensor, reading)
        self.check_files([index])
        return read_sweeps(listed, self.sensor, reading)

    def _annotation(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        file = self._boxes[self.names[index]]
        records = read_json(file, _Annotation).boxes
        boxes = np.array([record.box for record in records], np.float64).reshape(-1, 9)  # null becomes NaN
        check_boxes(boxes, lambda i: f"{file}: $.boxes[{i}].box")
        kept, labels = [], []
        for i, record in enumerate(records):
            label = self._translation.get(record.label, record.label)
            if label is not None:
                check_name(f"{file}: $.boxes[{i}].label", label, self.classes)
                kept.append(i)
                labels.append(self.classes.index(label))
        boxes = boxes[kept]
        boxes[:, 6] = wrap_angle(boxes[:, 6])
        return boxes.astype(np.float32), np.array(labels, np.int32)

    def _read_classes(self) -> tuple[tuple[str, ...], dict[str, str | None]]:
        """The classes, and what labels in the files become, None for boxes to leave out."""
        file = self.root / _CLASSES
        classes: list[str] | dict[str, str | None] = {}
        if os.path.lexists(file):
            classes = read_json(file, list[str] | dict[str, str | None])
        if isinstance(classes, list):
            if not classes or len(set(classes)) < len(classes):
                raise ValueError(f"{file}: got {len(classes)} names, expected at least one, each once")
            return tuple(classes), {}
        given = {r.label for boxes in self._boxes.values() for r in read_json(boxes, _Annotation).boxes}
        if unused := classes.keys() - given:
            labels = ", ".join(sorted(given))
            tell(f"note: {file}: no box has the label {min(unused)!r}; labels: {labels}", once=True)
        names = {classes.get(label, label) for label in given}
        return tuple(sorted(name for name in names if name is not None)), classes


def sensor_file(path: Path) -> Path | None:
    """The ``sensor.json`` of the folder of own data in one of whose folders a file is, or None."""
    root = Path(os.path.abspath(path)).parent.parent
    return file if (file := root / _SENSOR).is_file() and (root / _CLOUDS).is_dir() else None


def belongs_to_own_data(path: Path) -> bool:
    """Whether a path is the place of a description, or of a file in ``clouds/``, ``boxes/`` or ``sweeps/``."""
    folder = path.absolute().parent
    if path.name in (_SENSOR, _CLASSES, SPLITS):
        return (folder / _CLOUDS).is_dir()
    beside = {_CLOUDS: _BOXES, _BOXES: _CLOUDS, _SWEEPS: _CLOUDS}.get(folder.name)
    return beside is not None and (folder.parent / beside).is_dir()


def _list_files(root: Path, folder: str, endings: tuple[str, ...], inside: Path | None) -> dict[str, Path]:
    """Name without extension -> file; hidden files are skipped."""
    place, files = root / folder, dict[str, Path]()
    visible = [file for file in place.iterdir() if not file.name.startswith(".")] if place.is_dir() else []
    if not visible and folder != _SWEEPS:
        raise ValueError(f"{place}: found no file, expected a folder of {', '.join(endings)} files")
    for file in sorted(visible):
        ending = next((e for e in endings if file.name.lower().endswith(e)), None)
        if ending is None:
            raise ValueError(f"{file}: unknown extension {file.suffix!r}, expected {', '.join(endings)}")
        _expect_file(file, inside, str(file))
        name = file.name[: -len(ending)]
        if name in files:
            raise ValueError(f"{file}: a second file named {name} beside {files[name].name}, expected one")
        files[name] = file
    return files


def _expect_file(file: Path, inside: Path | None, where: str) -> None:
    """Refuse a missing file, and one that a link or ``..`` leads out of the folder ``inside``."""
    if not os.path.isfile(file):
        raise ValueError(f"{where}: no such file" + ("" if where == str(file) else f": {file}"))
    point_files.check_inside(file, inside, where)


def _read_split(root: Path, file: str | Path | None, split: str, clouds: Collection[str]) -> tuple[str, ...]:
    file = Path(file or root / SPLITS)
    splits, where = own_splits(root, file), f"{file}: {split}"
    check_name(f"{file}: split", split, splits)
    return distinct_names(((f"{where}[{i}]", name) for i, name in enumerate(splits[split])), clouds, where)
