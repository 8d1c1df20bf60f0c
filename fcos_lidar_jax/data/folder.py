"""The user's own annotated clouds: a folder of point files with boxes in JSON beside them."""

import difflib
import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from fcos_lidar_jax.data import point_files
from fcos_lidar_jax.data.frame import Frame, count_inside
from fcos_lidar_jax.data.sweeps import read_sweeps
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import PRESETS, Sensor, sensor_from_json
from fcos_lidar_jax.types import CLASSES

_FIELDS = ("x", "y", "z", "l", "w", "h", "yaw", "vx", "vy")
_LARGEST = float(np.finfo(np.float32).max)


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


class FolderFrames:
    """The frames of a folder, sorted by name: a :class:`~fcos_lidar_jax.data.frame.FrameSet`.

    ``sensor.json`` is a sensor as :func:`~fcos_lidar_jax.sensors.sensor_from_json` reads it, or a preset's name.
    ``clouds/NAME.EXT`` is any file that :func:`~fcos_lidar_jax.data.point_files.read_points` reads.
    ``boxes/NAME.json`` is ``{"boxes": [{"label": CLASS, "box": [x, y, z, l, w, h, yaw, vx, vy]}]}`` in the frame
    of the points, an unknown velocity ``null, null``; a frame without objects has an empty list.
    ``sweeps/NAME.json``, optional, is a list as :func:`~fcos_lidar_jax.data.sweeps.read_sweeps` reads it, its
    first entry the frame's own cloud. ``classes.json``, optional, translates own labels, null for boxes to leave
    out: ``{"lorry": "truck", "sign": null}``. No file may lie outside the folder, links included.

    Contents are read and checked when a frame is asked for, the names of all files at construction.

    Args:
        root: the folder.
        sensor: whose points they are; replaces ``sensor.json``.
        num_sweeps: clouds to fuse at most, from the first of the list on.
        remove_close: drop the points on the carrying vehicle, judged in each sweep's own frame: of ``"all"``
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
    >>> len(frames), frames.labels(0).tolist(), frames.frame(0).num_points.tolist()
    (1, [0], [1])
    """

    def __init__(
        self,
        root: str | Path,
        sensor: Sensor | None = None,
        *,
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
        self._classes = _read_classes(root)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.names)

    def frame(self, index: int) -> Frame:
        """One frame, read anew; the points in each box are counted."""
        boxes, labels = self._annotation(index)
        points = self._points(index)
        return Frame(points, boxes, labels, count_inside(points[points[:, 4] == 0], boxes))

    def labels(self, index: int) -> np.ndarray:
        """i32[m]: labels of the frame's boxes, without reading its points."""
        return self._annotation(index)[1]

    def name(self, index: int) -> str:
        """The cloud's name."""
        return self.names[index]

    def _points(self, index: int) -> np.ndarray:
        name = self.names[index]
        cloud, listed = self._clouds[name], self._sweeps.get(name)
        if listed is None or self.num_sweeps == 1:
            points = point_files.read_points(cloud, self.sensor)
            kept = np.ones(len(points), bool)
            kept = remove_close(points, kept, self.sensor, mode=self.remove_close, close_m=self.close_m)
            return points[np.asarray(kept)]
        self._check_sweeps(listed, cloud)
        return read_sweeps(
            listed,
            self.sensor,
            remove_close=self.remove_close,
            close_m=self.close_m,
            num_sweeps=self.num_sweeps,
        )[0]

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
        """Boxes and labels of the ten classes."""
        file = self._boxes[self.names[index]]
        boxes, labels = [], []
        for i, record in enumerate(_decode(file, _Annotation).boxes):
            where = f"{file}: $.boxes[{i}]"
            box = _check_box(record.box, f"{where}.box")
            if record.label not in self._classes:
                raise FolderError(f"{where}.label: {_unknown(record.label, self._classes)}")
            label = self._classes[record.label]
            if label is not None:
                boxes.append(box)
                labels.append(CLASSES.index(label))
        return np.array(boxes, np.float32).reshape(-1, 9), np.array(labels, np.int32)


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
        raise FolderError(f"{file}: {_unknown(record, PRESETS)}")
    return PRESETS[record]


def _read_classes(root: Path) -> dict[str, str | None]:
    """Label in the files -> one of the ten classes, or None for boxes to leave out."""
    file = root / "classes.json"
    own: dict[str, str | None] = {}
    if os.path.lexists(file):
        _expect_file(file, root, str(file))
        own = _decode(file, dict[str, str | None])
    for label, name in own.items():
        if name is not None and name not in CLASSES:
            raise FolderError(f"{file}: {label}: {_unknown(name, CLASSES)}")
    return {**{name: name for name in CLASSES}, **own}


def _check_box(box: list[float | None], where: str) -> list[float | None]:
    """The box with its yaw brought to [-pi, pi]."""
    if len(box) != len(_FIELDS):
        raise FolderError(f"{where}: got {len(box)} values, expected {len(_FIELDS)}: {', '.join(_FIELDS)}")
    for i, (name, value) in enumerate(zip(_FIELDS, box, strict=True)):
        velocity, got = name in ("vx", "vy"), f"{where}[{i}]: {name}: got {json.dumps(value)}"
        if value is None and velocity:
            continue
        # Numbers become 32-bit: what is too large for that is infinite, and a size that is too small is zero.
        if value is None or not abs(value) <= _LARGEST:
            raise FolderError(f"{got}, expected a finite number{' or null' if velocity else ''}")
        if name in ("l", "w", "h") and not np.float32(value) > 0:
            raise FolderError(f"{got}, expected a size above 0 m")
    if (box[7] is None) != (box[8] is None):
        raise FolderError(f"{where}: vx, vy: got {json.dumps(box[7:])}, expected two numbers, or null twice")
    return [*box[:6], math.remainder(box[6] or 0.0, math.tau), *box[7:]]


def _unknown(name: str, known: Iterable[str]) -> str:
    known = list(known)
    return f"got {name!r}, expected {' or '.join(difflib.get_close_matches(name, known)) or ', '.join(known)}"
