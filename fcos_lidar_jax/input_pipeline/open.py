"""One way to open any data set: its layout is recognised, its reader chosen, its classes translated."""

import dataclasses
from pathlib import Path
from typing import Any, Literal, assert_never

from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames, find_splits
from fcos_lidar_jax.data.class_mapping import ClassMap, MappedFrames, mapped_classes, unknown_name
from fcos_lidar_jax.data.folder import SPLITS, FolderFrames, read_splits
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.kitti import KittiFrames
from fcos_lidar_jax.data.nuscenes.reader import NuScenes, NuScenesFrames
from fcos_lidar_jax.data.nuscenes.splits import own_splits
from fcos_lidar_jax.sensors import ARGOVERSE2, KITTI_HDL64E, NUSCENES_HDL32E, Sensor
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, SimulatedFrames, city_frames

Format = Literal["nuscenes", "kitti", "argoverse2", "folder", "simulated"]

_MARKS: dict[Format, tuple[str, ...]] = {  # by what a layout is recognised: one of these is there
    "nuscenes": ("*/sample.json",),
    "kitti": ("training/velodyne",),
    "argoverse2": ("sensors/lidar", "*/sensors/lidar", "*/*/sensors/lidar"),
    "folder": ("clouds",),
}

_FULL_REACH_M = 45.0
_SIMULATED = {"train": (100_000, 0), "val": (400, UNSEEN_SEED)}  # number of frames, the first one's seed


@dataclasses.dataclass(frozen=True)
class Layout:
    """What kind of data set a folder holds."""

    root: Path
    format: Format
    version: str | None  # Folder of the tables, for nuScenes alone.

    @property
    def index(self) -> Path:
        """Where ``prepare`` writes by default, and where its index is looked for."""
        return self.root / ".fcos_lidar" / (self.version or "")


def find_layout(root: str | Path | None, format: Format | None = None, version: str | None = None) -> Layout:
    """What kind of data set a folder holds.

    Args:
        root: the folder; None for simulated frames.
        format: one of :data:`Format`; recognised by default.
        version: of nuScenes, which other formats have not; may be left out where there is one.

    Raises:
        ValueError: not one format's or version's, naming the folder and what was looked for.
    """
    if format == "simulated":
        if root is not None:
            raise ValueError(f"data root: got {root}, expected none for simulated frames")
        if version is not None:
            raise ValueError(f"version: got {version!r}, expected none for simulated frames")
        return Layout(Path("simulated"), format, None)
    if root is None:
        raise ValueError("data root: missing, expected the folder of a data set")
    root = Path(root)
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder, expected a data set")
    known = _recognise(root) if format is None else format
    if known not in _MARKS:
        raise ValueError(f"format: {unknown_name(known, _MARKS)}")
    if known == "nuscenes":
        there = sorted(file.parent.name for file in root.glob("*/sample.json")) if version is None else [version]
        if len(there) != 1:
            raise ValueError(f"{root}: got versions {', '.join(there) or '(none)'}, expected one: name it")
        version = there[0]
    elif version is not None:
        raise ValueError(f"version: got {version!r}, expected none: {root} is of format {known}")
    return Layout(root, known, version)


def _recognise(root: Path) -> Format:
    found: list[Format] = [
        name for name, marks in _MARKS.items() if any(next(root.glob(mark), None) for mark in marks)
    ]
    if len(found) > 1:
        raise ValueError(f"{root}: looks like {' and '.join(found)}, expected one format: name it")
    if not found:
        marks = ", ".join(f"{' or '.join(marks)} ({name})" for name, marks in _MARKS.items())
        raise ValueError(f"{root}: no known data set, expected one of {marks}")
    return found[0]


def default_split(
    layout: Layout, purpose: Literal["train", "val"], *, required: bool, splits: str | Path | None = None
) -> str | None:
    """The split that is meant unless another is named: ``train`` or ``val``.

    For nuScenes versions that end in mini: ``mini_train`` or ``mini_val``.

    Args:
        layout: of the data set.
        purpose: what it is for.
        required: where the data have one other split alone, take that, unless it is for the other purpose by its
            name; where they have several, refuse to choose.
        splits: JSON file of own splits.

    Returns:
        a name, or None where the data have no splits, and, if it is not required, where they have no such split.

    Raises:
        ValueError: one is required, and the splits are several or for the other purpose.
    """
    name = f"mini_{purpose}" if (layout.version or "").endswith("mini") else purpose
    names = _split_names(layout, splits)
    if name in names or (layout.format == "nuscenes" and not names):
        return name
    if not required or not names:
        return None
    if len(names) > 1 or names[0] in ("train", "val", "mini_train", "mini_val"):
        raise ValueError(f"{layout.root}: split: got splits {', '.join(names)}, none is {name}: name one")
    return names[0]


def _split_names(layout: Layout, splits: str | Path | None) -> list[str]:
    """Splits that the data set defines itself; nuScenes' official ones are in its devkit."""
    if layout.format == "nuscenes":
        return list(own_splits(layout.root / (layout.version or ""), splits))
    if layout.format == "simulated":
        return list(_SIMULATED)
    if layout.format == "kitti":
        return sorted(file.stem for file in (layout.root / "ImageSets").glob("*.txt"))
    if layout.format == "argoverse2":
        return find_splits(layout.root)
    if layout.format == "folder":
        file = layout.root / SPLITS if splits is None else Path(splits)
        return list(read_splits(file)) if splits is not None or file.exists() else []
    assert_never(layout.format)


def open_frames(
    root: str | Path | None = None,
    *,
    format: Format | None = None,
    version: str | None = None,
    split: str | None = None,
    sensor: Sensor | None = None,
    num_sweeps: int = 1,
    remove_close: Literal["all", "sweeps", "none"] = "sweeps",
    close_m: float = 1.0,
    class_map: ClassMap | None = None,
    index: str | Path | None = None,
    splits: str | Path | None = None,
    allow_missing_sweeps: bool = False,
    follow_links: bool = False,
) -> FrameSet:
    """The frames of a data set in any layout that there is a reader for.

    Args:
        root: the folder; None for simulated frames.
        format: ``"nuscenes"``, ``"kitti"``, ``"argoverse2"``, ``"folder"`` or ``"simulated"``; by default
            recognised.
        version: of nuScenes; may be left out where there is one.
        split: name of the part that is wanted; all frames by default, see also :func:`default_split`.
        sensor: whose points they are; by default the format's own.
        num_sweeps: sweeps fused at most, the current one included; fewer where the data have fewer.
        remove_close: drop the points on the ego vehicle, judged in each sweep's own frame: of ``"all"`` sweeps, of
            the older ``"sweeps"``, or ``"none"``.
        close_m: half the side of the square that is emptied, metres.
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
    layout = find_layout(root, format, version)
    refused = {"index": index, "allow_missing_sweeps": allow_missing_sweeps or None}
    if layout.format != "folder":
        refused |= {"splits": splits, "follow_links": follow_links or None}
    for name, value in refused.items():
        if value is not None and layout.format != "nuscenes":
            raise ValueError(f"{name}: got {value}, expected none: {layout.root} is of format {layout.format}")
    if num_sweeps < 1:
        raise ValueError(f"num_sweeps: got {num_sweeps}, expected at least 1")
    close: Any = {"remove_close": remove_close, "close_m": close_m}
    if layout.format == "simulated":
        frames = _simulated_frames(split, sensor or NUSCENES_HDL32E, num_sweeps, remove_close, close_m)
    elif layout.format == "nuscenes":
        allowed = {"allow_missing_sweeps": allow_missing_sweeps, "follow_links": follow_links}
        data = NuScenes(layout.root, str(layout.version), index=index, **allowed)
        tokens = data.sample_tokens if split is None else data.split(split, file=splits)
        frames = NuScenesFrames(data, tuple(tokens), num_sweeps, sensor=sensor or NUSCENES_HDL32E, **close)
    elif layout.format == "kitti":
        frames = KittiFrames(layout.root, split, sensor=sensor or KITTI_HDL64E, **close)
    elif layout.format == "argoverse2":
        frames = Argoverse2Frames(layout.root, split, sensor=sensor or ARGOVERSE2, num_sweeps=num_sweeps, **close)
    elif layout.format == "folder":
        close["follow_links"] = follow_links
        frames = FolderFrames(layout.root, sensor, split=split, splits=splits, num_sweeps=num_sweeps, **close)
    else:
        assert_never(layout.format)
    if class_map is None:
        return frames
    return MappedFrames(frames, mapped_classes(frames.classes, class_map), class_map)


def _simulated_frames(
    split: str | None, sensor: Sensor, num_sweeps: int, remove_close: str, close_m: float
) -> FrameSet:
    """Streets that fit the sensor: what is near in plain ones for one of a short reach, else varied ones."""
    split = split or "train"
    if split not in _SIMULATED:
        raise ValueError(f"split: {unknown_name(split, _SIMULATED)}")
    number, first = _SIMULATED[split]
    # The simulated ego vehicle has no body that the sensor could see: what is close is the road.
    close_m = 0.0 if remove_close == "none" else close_m
    if sensor.limit_xy_m < _FULL_REACH_M:
        return SimulatedFrames(sensor, number, first, num_sweeps=num_sweeps, close_m=close_m)
    return dataclasses.replace(city_frames(sensor, number, first), num_sweeps=num_sweeps, close_m=close_m)
