"""The user's own annotated clouds: a folder of point files with boxes in JSON beside them."""

import json
import math
import os
from collections.abc import Container
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from fcos_lidar_jax.data import point_files
from fcos_lidar_jax.data.box_geometry import LIMITS, count_inside
from fcos_lidar_jax.data.classes import unknown_name
from fcos_lidar_jax.data.frame import Frame, FrameSet, drop_close, files_fingerprint
from fcos_lidar_jax.data.sweeps import read_list, read_sweeps
from fcos_lidar_jax.sensors import PRESETS, Sensor, sensor_from_json

SPLITS = "splits.json"


class FolderError(ValueError):
    """A folder that cannot be used: one line with the file, the record, the field, found and expected."""


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    """One box, in the shape that ``fcos-lidar detect`` writes."""

    label: str
    box: list[float | None]
    score: float | None = None  # a detector's; a corrected prediction may keep it


class _Annotation(msgspec.Struct, forbid_unknown_fields=True):
    boxes: list[_Record]


class _Sweep(msgspec.Struct):
    """What the folder has to know of a sweep; ``read_sweeps`` checks the rest."""

    file: str


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
        num_sweeps: clouds to fuse at most, from the first of the list on.
        remove_close: drop the points on the ego vehicle, judged in each sweep's own frame: of ``"all"``
            sweeps, of the older ``"sweeps"``, or ``"none"``.
        close_m: half the side of the square that is emptied, metres.

    Raises:
        FolderError: here or on reading a frame, naming the file, the field, what was found and what was expected.
        ValueError: a point file, a list of sweeps or a sensor that cannot be used, in the same form.

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
        num_sweeps: int = 10,
        remove_close: Literal["all", "sweeps", "none"] = "all",
        close_m: float = 1.0,
    ) -> None:
        """List the folder and see that the files belong together."""
        root = Path(root)
        if num_sweeps < 1:
            raise ValueError(f"num_sweeps: got {num_sweeps}, expected at least 1")
        if remove_close not in ("all", "sweeps", "none"):
            raise ValueError(f"remove_close: got {remove_close!r}, expected 'all', 'sweeps' or 'none'")
        self.root, self.num_sweeps, self.remove_close, self.close_m = root, num_sweeps, remove_close, close_m
        self._clouds = _list_files(root, "clouds", point_files.ENDINGS)
        self._boxes = _list_files(root, "boxes", (".json",))
        self._sweeps = _list_files(root, "sweeps", (".json",)) if (root / "sweeps").exists() else {}
        if not self._clouds:
            raise FolderError(f"{root / 'clouds'}: no point file in it, expected at least one")
        for files in (self._boxes, self._sweeps):
            for name in sorted(files.keys() - self._clouds.keys()):
                raise FolderError(f"{files[name]}: no cloud named {name} in {root / 'clouds'}, expected one")
        for name in sorted(self._clouds.keys() - self._boxes.keys()):
            raise FolderError(
                f"{self._clouds[name]}: no {root / 'boxes' / name}.json, expected one for every cloud, "
                '{"boxes": []} where there is no object'
            )
        self.names = tuple(sorted(self._clouds))
        """Names of the frames: of their files, without the extension."""
        self.sensor = _read_sensor(root) if sensor is None else sensor
        """Whose points they are."""
        self.classes, self._translation = self._read_classes()
        if split is not None:
            self.names = _read_split(root / SPLITS if splits is None else Path(splits), split, self._clouds)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.names)

    def frame(self, index: int) -> Frame:
        """One frame, read anew; the points in each box are counted."""
        boxes, labels = self._annotation(index)
        points, num_close = self._points(index)
        return Frame(points, boxes, labels, count_inside(points[points[:, 4] == 0], boxes), num_close)

    def labels(self, index: int) -> np.ndarray:
        """i32[m]: labels of the frame's boxes, without reading its points."""
        return self._annotation(index)[1]

    def name(self, index: int) -> str:
        """The cloud's name."""
        return self.names[index]

    def pose(self, index: int) -> np.ndarray | None:
        """Of the list of sweeps, where the frame has one."""
        listed = self._sweeps.get(self.names[index])
        return None if listed is None else read_list(listed)[0].sensor_to_world

    def time_us(self, index: int) -> int | None:
        """Of the list of sweeps, where the frame has one."""
        listed = self._sweeps.get(self.names[index])
        return None if listed is None else read_list(listed)[0].time_us

    def fingerprint(self) -> str:
        """Checksum of all files by name, size and time of change, and of the frames and the reading options."""
        files = [*self._clouds.values(), *self._boxes.values(), *self._sweeps.values()]
        files += [file for name in ("sensor.json", "classes.json") if (file := self.root / name).exists()]
        reading = self.names, self.sensor, self.num_sweeps, self.remove_close, self.close_m
        return files_fingerprint(files, self.root, reading)

    def _points(self, index: int) -> tuple[np.ndarray, int]:
        name = self.names[index]
        cloud, listed = self._clouds[name], self._sweeps.get(name)
        if listed is None or self.num_sweeps == 1:
            points = point_files.read_points(cloud, self.sensor)
            return drop_close(points, self.sensor, mode=self.remove_close, close_m=self.close_m)
        self._check_sweeps(listed, cloud)
        return read_sweeps(
            listed,
            self.sensor,
            remove_close=self.remove_close,
            close_m=self.close_m,
            num_sweeps=self.num_sweeps,
        )

    def _check_sweeps(self, listed: Path, cloud: Path) -> None:
        sweeps = _decode(listed, Annotated[list[_Sweep], msgspec.Meta(min_length=1)])
        for i, sweep in enumerate(sweeps):
            _expect_file(listed.parent / sweep.file, self.root, f"{listed}: $[{i}].file")
        if (listed.parent / sweeps[0].file).resolve() != cloud.resolve():
            own = f"../clouds/{cloud.name}"
            raise FolderError(
                f"{listed}: $[0].file: got {sweeps[0].file!r}, expected the frame's own cloud, {own!r}"
            )

    def _annotation(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        file = self._boxes[self.names[index]]
        boxes, labels = [], []
        for i, record in enumerate(_decode(file, _Annotation).boxes):
            where = f"{file}: $.boxes[{i}]"
            box = _check_box(record.box, f"{where}.box")
            label = self._translation.get(record.label, record.label)
            if label is not None:
                if label not in self.classes:
                    raise FolderError(f"{where}.label: {unknown_name(label, self.classes)}")
                boxes.append(box)
                labels.append(self.classes.index(label))
        return np.array(boxes, np.float32).reshape(-1, 9), np.array(labels, np.int32)

    def _read_classes(self) -> tuple[tuple[str, ...], dict[str, str | None]]:
        """The classes, and what labels in the files become, None for boxes to leave out."""
        file = self.root / "classes.json"
        own: list[str] | dict[str, str | None] = {}
        if os.path.lexists(file):
            _expect_file(file, self.root, str(file))
            own = _decode(file, list[str] | dict[str, str | None])
        if isinstance(own, list):
            if not own or len(set(own)) < len(own):
                raise FolderError(f"{file}: got {len(own)} names, expected at least one, each once")
            return tuple(own), {}
        found = {own.get(r.label, r.label) for f in self._boxes.values() for r in _decode(f, _Annotation).boxes}
        return tuple(sorted(name for name in found if name is not None)), own


def _list_files(root: Path, folder: str, endings: tuple[str, ...]) -> dict[str, Path]:
    """Name without extension -> file; hidden files are left out."""
    if not (root / folder).is_dir():
        raise FolderError(f"{root / folder}: no such folder, expected one with {', '.join(endings)} files")
    files: dict[str, Path] = {}
    for file in sorted((root / folder).iterdir()):
        if file.name.startswith("."):
            continue
        ending = next((e for e in endings if file.name.lower().endswith(e)), None)
        if ending is None:
            raise FolderError(f"{file}: unknown extension {file.suffix!r}, expected {', '.join(endings)}")
        _expect_file(file, root, str(file))
        name = file.name[: -len(ending)]
        if name in files:
            raise FolderError(f"{file}: a second file named {name} beside {files[name].name}, expected one")
        files[name] = file
    return files


def _expect_file(file: Path, root: Path, where: str) -> None:
    if not file.is_file():
        raise FolderError(f"{where}: no such file" + ("" if where == str(file) else f": {file}"))
    real = os.path.realpath(file)
    if not Path(real).is_relative_to(os.path.realpath(root)):
        raise FolderError(f"{where}: leads to {real}, expected a file inside {root}")


def _decode(file: Path, kind: Any) -> Any:
    # Python's own parser lets NaN pass, so that it can be refused with the name of its field.
    try:
        return msgspec.convert(json.loads(file.read_text(encoding="utf-8")), kind)
    except msgspec.ValidationError as error:
        raise FolderError(f"{file}: {error}") from None
    except OSError as error:
        raise FolderError(f"{file}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise FolderError(f"{file}: not JSON: {error}") from None


def _read_sensor(root: Path) -> Sensor:
    file = root / "sensor.json"
    _expect_file(file, root, str(file))
    record = _decode(file, str | dict[str, Any])
    if isinstance(record, dict):
        return sensor_from_json(record, str(file))
    if record not in PRESETS:
        raise FolderError(f"{file}: {unknown_name(record, PRESETS)}")
    return PRESETS[record]


def read_splits(file: Path) -> dict[str, list[str]]:
    """The splits of a ``splits.json``: name -> frames."""
    if not file.is_file():
        raise FolderError(f"{file}: no such file, expected splits")
    return _decode(file, dict[str, list[str]])


def _read_split(file: Path, split: str, clouds: Container[str]) -> tuple[str, ...]:
    splits = read_splits(file)
    if split not in splits:
        raise FolderError(f"{file}: split: {unknown_name(split, splits)}")
    names: dict[str, None] = {}
    for i, name in enumerate(splits[split]):
        if name not in clouds:
            raise FolderError(f"{file}: {split}[{i}]: got {name!r}, expected the name of a cloud")
        if name in names:
            raise FolderError(f"{file}: {split}[{i}]: got {name!r} a second time, expected every frame once")
        names[name] = None
    if not names:
        raise FolderError(f"{file}: {split}: no frame in it, expected at least one")
    return tuple(names)


def _check_box(box: list[float | None], where: str) -> list[float | None]:
    """The box with its yaw brought to [-pi, pi]."""
    if len(box) != len(LIMITS):
        raise FolderError(f"{where}: got {len(box)} values, expected {len(LIMITS)}: {', '.join(LIMITS)}")
    for i, (name, value) in enumerate(zip(LIMITS, box, strict=True)):
        velocity, got = name in ("vx", "vy"), f"{where}[{i}]: {name}: got {json.dumps(value)}"
        if value is None and velocity:
            continue
        if value is None or not math.isfinite(value):
            raise FolderError(f"{got}, expected a finite number{' or null' if velocity else ''}")
        if abs(value) > LIMITS[name]:
            raise FolderError(f"{got}, expected at most {LIMITS[name]:g}")
        # Numbers become 32-bit: a size that is too small for that is zero.
        if name in ("l", "w", "h") and not np.float32(value) > 0:
            raise FolderError(f"{got}, expected a size above 0 m")
    if (box[7] is None) != (box[8] is None):
        raise FolderError(f"{where}: vx, vy: got {json.dumps(box[7:])}, expected two numbers, or null twice")
    return [*box[:6], math.remainder(box[6] or 0.0, math.tau), *box[7:]]
