"""One function to open any data set; a table has one row per format."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data import argoverse2, kitti
from fcos_lidar_jax.data.class_mapping import ClassMap, MappedFrames
from fcos_lidar_jax.data.folder import FolderFrames
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes.index import default_index
from fcos_lidar_jax.data.nuscenes.names import TO_KITTI
from fcos_lidar_jax.data.nuscenes.reader import open_keyframes
from fcos_lidar_jax.data.nuscenes.splits import official_splits
from fcos_lidar_jax.data.recorded import check_scale
from fcos_lidar_jax.data.splits import own_splits
from fcos_lidar_jax.fields import check_name
from fcos_lidar_jax.files import local_path
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E, Sensor, in_frame_of
from fcos_lidar_jax.simulation.frame_set import SIMULATED_SPLITS, simulated_split

Format = Literal["nuscenes", "kitti", "argoverse2", "folder", "simulated"]


@dataclasses.dataclass(frozen=True)
class Reader:
    """A format of data sets."""

    name: Format
    marks: tuple[str, ...]  # glob patterns of folders in this format; () if the frames are not on disk
    sensor: Sensor | None  # gives heading, position and intensity scale; None if the data name their sensor
    splits: Callable[["DataSet", str | Path | None], list[str]]  # (data set, file of custom splits) -> their names
    open: Callable[..., FrameSet]  # (data set, *, split, sensor, reading, **options) -> frames
    options: tuple[str, ...] = ()  # further options of open_frames that this format takes
    class_maps: Mapping[str, ClassMap] = dataclasses.field(default_factory=dict)  # by the data set they lead to
    result_folders: bool = False  # ``evaluate`` takes folders of KITTI result files

    @property
    def named_maps(self) -> str:
        """The names of the class maps, as part of a message."""
        return f"the class maps of format {self.name}: {', '.join(self.class_maps) or '(none)'}"


READERS = (
    Reader(
        "nuscenes",
        ("*/sample.json",),
        NUSCENES_HDL32E,
        lambda data, file: list(own_splits(data.root / data.version, file) or official_splits()),
        lambda data, **how: open_keyframes(data.root, data.version, **how),
        ("version", "index", "splits", "allow_missing_sweeps", "follow_links"),
        class_maps={"kitti": TO_KITTI},
    ),
    Reader(
        "kitti",
        ("training/velodyne",),
        KITTI_HDL64E,
        lambda data, _: sorted(file.stem for file in (data.root / "ImageSets").glob("*.txt")),
        lambda data, **how: kitti.KittiFrames(data.root, **how),
        ("full_turn", "intensity_scale"),
        class_maps={"nuscenes": kitti.TO_NUSCENES},
        result_folders=True,
    ),
    Reader(
        "argoverse2",
        ("sensors/lidar", "*/sensors/lidar", "*/*/sensors/lidar"),
        ARGOVERSE2,
        lambda data, _: argoverse2.find_splits(data.root),
        lambda data, **how: argoverse2.Argoverse2Frames(data.root, **how),
        ("intensity_scale",),
        class_maps={"nuscenes": argoverse2.TO_NUSCENES},
    ),
    Reader(
        "folder",
        ("clouds",),
        None,
        lambda data, file: list(own_splits(data.root, file)),
        lambda data, **how: FolderFrames(data.root, **how),
        ("splits", "follow_links", "intensity_scale"),
    ),
    Reader(
        "simulated",
        (),
        NUSCENES_HDL32E,
        lambda data, _: list(SIMULATED_SPLITS),
        lambda data, split, **how: simulated_split(split or "train", **how),
        class_maps={"kitti": TO_KITTI},
    ),
)

CLASS_MAPS = frozenset(name for reader in READERS for name in reader.class_maps)
"""Names of the class maps of all formats."""


class MissingRootError(ValueError):
    """No folder is given, for a format that needs one."""


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
        """The default folder of ``prepare``'s output."""
        return default_index(self.root, self.version)


def find_data_set(root: str | Path | None, format: str | None = None, version: str | None = None) -> DataSet:
    """The data set in a folder, or, without one, simulated frames.

    By default the format and, if there is only one, the version of nuScenes are recognised; messages name the
    patterns.
    """
    readers: dict[str, Reader] = {reader.name: reader for reader in READERS}
    if format is not None:
        check_name("format", format, readers)
    reader = readers[format] if format else None
    if reader is not None and not reader.marks:
        if root is not None:
            raise ValueError(f"data root: got {root}, expected none for {format} frames")
        data = DataSet(Path(reader.name), reader)
    elif root is None:
        raise MissingRootError("data root: missing, expected the folder of a data set")
    elif not local_path(root).is_dir():
        raise ValueError(f"{root}: no such folder, expected a data set")
    else:
        data = DataSet(Path(root), reader or _recognise(Path(root)))
    if "version" not in data.reader.options:
        _refuse(data, version=version)
        return data
    versions = sorted(file.parent.name for file in data.root.glob("*/sample.json"))
    if not version and len(versions) == 1:
        version = versions[0]
    if not version or not (data.root / version).is_dir():
        known = ", ".join(versions) or "(none)"
        raise ValueError(f"{data.root}: version: got {version or 'none'}, expected one of {known}")
    return dataclasses.replace(data, version=version)


def _recognise(root: Path) -> Reader:
    matching = [reader for reader in READERS if any(any(root.glob(mark)) for mark in reader.marks)]
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
    """The default split for a purpose: ``train`` or ``val``; ``mini_train`` or ``mini_val`` for nuScenes mini.

    If that split is missing but one is ``required``, the only other split is taken, unless its name belongs to the
    other purpose. If there are several others, an error asks for a choice. Returns None if the data have no
    splits, or if that split is missing and not required. ``splits`` is a file of custom splits.
    """
    names, name = data.reader.splits(data, splits), purpose
    if data.version.endswith("mini") and f"mini_{purpose}" in names:
        name = f"mini_{purpose}"
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
    class_map: ClassMap | str | None = None,
    index: str | Path | None = None,
    splits: str | Path | None = None,
    allow_missing_sweeps: bool = False,
    follow_links: bool = False,
    full_turn: bool = False,
    intensity_scale: float | None = None,
) -> FrameSet:
    """Open a data set in any supported format.

    Args:
        root: the folder; None for simulated frames.
        format: ``"nuscenes"``, ``"kitti"``, ``"argoverse2"``, ``"folder"`` or ``"simulated"``; default:
            recognised.
        version: version of nuScenes; may be omitted if there is only one.
        split: name of a split; default: all frames. See also :func:`default_split`.
        sensor: gives the range image; default: the sensor that recorded the points. All formats but the folder
            keep the heading, the position and the intensity scale of their own sensors; in nuScenes and simulated
            frames, y points forward and the LiDAR is at the origin.
        num_sweeps: maximum number of sweeps to fuse, including the current one; default: ``reading``'s.
        reading: how clouds are read, such as ``config.reading``; default: ``CloudReading()``.
        class_map: name in the data -> name to use instead; None drops objects, other names stay. Or the name of a
            class map: ``"nuscenes"`` (KITTI and Argoverse 2), ``"kitti"`` (nuScenes and simulated frames).
        index: folder of the index that ``prepare`` wrote (nuScenes).
        splits: JSON file of custom splits, ``{"name": [...]}`` of scenes (nuScenes) or frames (folder).
        allow_missing_sweeps: skip older sweeps with a missing file (nuScenes).
        follow_links: also read files outside the root to which links lead (nuScenes, folder).
        full_turn: keep the points outside the camera's image, where no objects are labelled (KITTI).
        intensity_scale: replaces the sensor's (KITTI, Argoverse 2, folder).

    Returns:
        frames with labels of their own classes; :class:`~fcos_lidar_jax.data.class_mapping.MappedFrames` maps them
        to a detector's classes.

    Raises:
        ValueError: one line with the found and the expected value.

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
        "full_turn": full_turn,
    }
    _refuse(data, **given, intensity_scale=intensity_scale)
    check_scale(intensity_scale, data.root.rglob("*.pcd.bin"))
    if isinstance(class_map, str):
        if class_map not in data.reader.class_maps:
            raise ValueError(f"class map: got {class_map!r}, expected one of {data.reader.named_maps}")
        class_map = data.reader.class_maps[class_map]
    reading = reading or CloudReading()
    if num_sweeps is not None:
        reading = dataclasses.replace(reading, num_sweeps=num_sweeps)
    options = {name: value for name, value in given.items() if name in data.reader.options}
    open_with = functools.partial(data.reader.open, data, split=split, reading=reading, **options)
    sensor = _recording_sensor(data, sensor, intensity_scale)
    if intensity_scale is not None:
        sensor = sensor or open_with(sensor=None).sensor  # only the frames know the sensor of a folder
        sensor = dataclasses.replace(sensor, intensity_scale=intensity_scale)
    frames = open_with(sensor=sensor)
    if class_map is None:
        return frames
    names = (class_map.get(name, name) for name in frames.classes)
    return MappedFrames(frames, tuple(dict.fromkeys(name for name in names if name is not None)), class_map)


def _recording_sensor(data: DataSet, sensor: Sensor | None, intensity_scale: float | None) -> Sensor | None:
    """The range image of ``sensor`` in the frame of the sensor that recorded the data, if the format has one."""
    recorded = data.reader.sensor
    if sensor is None or recorded is None:
        return sensor or recorded
    combined, told = in_frame_of(sensor, recorded), list[str]()
    if intensity_scale is None and combined.intensity_scale != sensor.intensity_scale:
        told.append(f"intensities are scaled by {combined.intensity_scale:g}")
    if combined.origin_m != sensor.origin_m:
        told.append(f"the LiDAR is at {combined.origin_m} m")
    if told:
        tell(f"{data.root}: {' and '.join(told)}, as for all data of format {data.reader.name}", once=True)
    return combined
