"""One way to open any data set: one row per format says how it is recognised and read."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames, find_splits
from fcos_lidar_jax.data.class_mapping import ClassMap, MappedFrames, mapped_classes, unknown_name
from fcos_lidar_jax.data.folder import FolderFrames, find_folder_splits
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.kitti import KittiFrames
from fcos_lidar_jax.data.nuscenes.reader import open_keyframes
from fcos_lidar_jax.data.nuscenes.splits import OFFICIAL, own_splits
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E, Sensor
from fcos_lidar_jax.simulation.frame_set import SIMULATED_SPLITS, simulated_split

Format = Literal["nuscenes", "kitti", "argoverse2", "folder", "simulated"]


@dataclasses.dataclass(frozen=True)
class Reader:
    """A format of data sets.

    Attributes:
        name: one of :data:`Format`.
        marks: patterns; a folder where one of them matches is of this format. ``()``: the frames are not on disk.
        sensor: whose points the frames hold unless told otherwise; None where the data say it.
        splits: ``(data set, file of own splits) -> names of the splits``.
        open: ``(data set, split, sensor, reading, **options) -> frames``.
        options: further options of :func:`open_frames` that this format takes.
    """

    name: Format
    marks: tuple[str, ...]
    sensor: Sensor | None
    splits: Callable[["DataSet", str | Path | None], list[str]]
    open: Callable[..., FrameSet]
    options: tuple[str, ...] = ()


READERS = (
    Reader(
        "nuscenes",
        ("*/sample.json",),
        NUSCENES_HDL32E,
        lambda data, file: list(own_splits(data.root / data.version, file) or OFFICIAL),
        lambda data, *how, **options: open_keyframes(data.root, data.version, *how, **options),
        ("version", "index", "splits", "allow_missing_sweeps", "follow_links"),
    ),
    Reader(
        "kitti",
        ("training/velodyne",),
        KITTI_HDL64E,
        lambda data, _: sorted(file.stem for file in (data.root / "ImageSets").glob("*.txt")),
        lambda data, split, sensor, reading: KittiFrames(data.root, split, sensor=sensor, reading=reading),
    ),
    Reader(
        "argoverse2",
        ("sensors/lidar", "*/sensors/lidar", "*/*/sensors/lidar"),
        ARGOVERSE2,
        lambda data, _: find_splits(data.root),
        lambda data, split, sensor, reading: Argoverse2Frames(data.root, split, sensor=sensor, reading=reading),
    ),
    Reader(
        "folder",
        ("clouds",),
        None,
        lambda data, file: find_folder_splits(data.root, file),
        lambda data, split, sensor, reading, **options: FolderFrames(
            data.root, sensor, split=split, reading=reading, **options
        ),
        ("splits", "follow_links"),
    ),
    Reader(
        "simulated",
        (),
        NUSCENES_HDL32E,
        lambda data, _: list(SIMULATED_SPLITS),
        lambda data, split, sensor, reading: simulated_split(split or "train", sensor, reading),
    ),
)


@dataclasses.dataclass(frozen=True)
class DataSet:
    """A folder and its format."""

    root: Path
    reader: Reader
    version: str = ""  # Folder of the tables, for nuScenes only.

    @property
    def on_disk(self) -> bool:
        return bool(self.reader.marks)

    @property
    def tables(self) -> Path | None:
        """The folder of nuScenes' tables; None for other formats."""
        return self.root / self.version if self.version else None

    @property
    def index(self) -> Path:
        """Where ``prepare`` writes by default, and where its index is looked for."""
        return self.root / ".fcos_lidar" / self.version


def find_data_set(root: str | Path | None, format: str | None = None, version: str | None = None) -> DataSet:
    """The format of the data set that a folder holds.

    Args:
        root: the folder; None for simulated frames.
        format: one of :data:`Format`; recognised by default.
        version: of nuScenes, which other formats have not; may be left out where there is one.

    Raises:
        ValueError: not one format's or version's, naming the folder and what was looked for.
    """
    if format is not None and format not in (names := [reader.name for reader in READERS]):
        raise ValueError(f"format: {unknown_name(format, names)}")
    readers = [reader for reader in READERS if reader.name == format]
    if readers and not readers[0].marks:
        if root is not None:
            raise ValueError(f"data root: got {root}, expected none for {format} frames")
        data = DataSet(Path(readers[0].name), readers[0])
    else:
        if root is None:
            raise ValueError("data root: missing, expected the folder of a data set")
        root = Path(root)
        if not root.is_dir():
            raise ValueError(f"{root}: no such folder, expected a data set")
        data = DataSet(root, readers[0] if readers else _recognise(root))
    if "version" not in data.reader.options:
        _refuse(data, version=version)
        return data
    there = [version] if version else sorted(file.parent.name for file in data.root.glob("*/sample.json"))
    if len(there) != 1:
        raise ValueError(f"{root}: got versions {', '.join(there) or '(none)'}, expected one: name it")
    return dataclasses.replace(data, version=there[0])


def _recognise(root: Path) -> Reader:
    matching = [reader for reader in READERS if any(next(root.glob(mark), None) for mark in reader.marks)]
    if len(matching) > 1:
        names = " and ".join(reader.name for reader in matching)
        raise ValueError(f"{root}: looks like {names}, expected one format: name it")
    if not matching:
        marks = ", ".join(f"{' or '.join(reader.marks)} ({reader.name})" for reader in READERS if reader.marks)
        raise ValueError(f"{root}: no known data set, expected one of {marks}")
    return matching[0]


def _refuse(data: DataSet, **options: object) -> None:
    for name, value in options.items():
        if value and name not in data.reader.options:
            raise ValueError(f"{name}: got {value}, expected none: {data.root} is of format {data.reader.name}")


def default_split(
    data: DataSet, purpose: Literal["train", "val"], *, required: bool, splits: str | Path | None = None
) -> str | None:
    """The split that is meant unless another is named: ``train`` or ``val``.

    For nuScenes versions that end in mini: ``mini_train`` or ``mini_val``.

    Args:
        data: the data set.
        purpose: what it is for.
        required: where the data have only one other split, take that, unless it is for the other purpose by its
            name; where they have several, refuse to choose.
        splits: JSON file of own splits.

    Returns:
        a name, or None where the data have no splits, and, if it is not required, where they have no such split.

    Raises:
        ValueError: one is required, and the splits are several or for the other purpose.
    """
    name = f"mini_{purpose}" if data.version.endswith("mini") else purpose
    names = data.reader.splits(data, splits)
    if name in names:
        return name
    if not required or not names:
        return None
    if len(names) > 1 or names[0] in ("train", "val", "mini_train", "mini_val"):
        raise ValueError(f"{data.root}: split: got splits {', '.join(names)}, none is {name}: name one")
    return names[0]


def open_frames(
    root: str | Path | None = None,
    *,
    format: Format | None = None,
    version: str | None = None,
    split: str | None = None,
    sensor: Sensor | None = None,
    num_sweeps: int | None = None,
    reading: CloudReading | None = None,
    class_map: ClassMap | None = None,
    index: str | Path | None = None,
    splits: str | Path | None = None,
    allow_missing_sweeps: bool = False,
    follow_links: bool = False,
) -> FrameSet:
    """The frames of a data set in any format that there is a reader for.

    Args:
        root: the folder; None for simulated frames.
        format: ``"nuscenes"``, ``"kitti"``, ``"argoverse2"``, ``"folder"`` or ``"simulated"``; by default
            recognised.
        version: of nuScenes; may be left out where there is one.
        split: name of the part that is wanted; all frames by default, see also :func:`default_split`.
        sensor: whose points they are; by default the format's own.
        num_sweeps: sweeps fused at most, the current one included; default: as in ``reading``.
        reading: which points are read, such as ``config.reading``; default: ``CloudReading()``.
        class_map: the data's name -> another, None for objects to leave out; other names stay.
        index: of nuScenes, where ``prepare`` has put it.
        splits: JSON file of own splits, ``{"name": [scene, ...]}`` for nuScenes, of frames for a folder.
        allow_missing_sweeps: of nuScenes: continue without older sweeps whose file is missing.
        follow_links: of nuScenes and folders: read files to which links lead outside of the root.

    Returns:
        frames with labels of their own classes; :class:`~fcos_lidar_jax.data.class_mapping.MappedFrames` brings
        them to those of a detector.

    Raises:
        ValueError: in one line, what was found and what was expected.

    >>> import tempfile
    >>> open_frames(tempfile.mkdtemp())  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: ...: no known data set, expected one of ...
    """
    data = find_data_set(root, format, version)
    given: dict[str, Any] = {
        "index": index,
        "splits": splits,
        "allow_missing_sweeps": allow_missing_sweeps,
        "follow_links": follow_links,
    }
    _refuse(data, **given)
    reading = reading or CloudReading()
    if num_sweeps is not None:
        reading = dataclasses.replace(reading, num_sweeps=num_sweeps)
    options = {name: value for name, value in given.items() if name in data.reader.options}
    frames = data.reader.open(data, split, sensor or data.reader.sensor, reading, **options)
    if class_map is None:
        return frames
    return MappedFrames(frames, mapped_classes(frames.classes, class_map), class_map)
