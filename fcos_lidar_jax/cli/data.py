"""The options that name a data set, the same for every command."""

import dataclasses
from pathlib import Path
from typing import Literal

from fcos_lidar_jax.cli.processes import tell
from fcos_lidar_jax.config import CloudReading, Config
from fcos_lidar_jax.data.class_mapping import ClassMap, MappedFrames
from fcos_lidar_jax.data.frame import FrameSet, SelectedFrames
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.input_pipeline.open import DataSet, Format, default_split, find_data_set, open_frames
from fcos_lidar_jax.sensors import Sensor, load_sensor


@dataclasses.dataclass(frozen=True)
class DataOptions:
    """Which data set, and how it is read."""

    data_root: Path | None = None  # Folder of the data set; --format simulated needs none.
    format: Format | None = None  # Layout of the data set; recognised by default.
    version: str | None = None
    """nuScenes: folder of the tables, such as v1.0-trainval; may be left out where there is one."""
    index: Path | None = None
    """Where fcos-lidar prepare puts the objects and, for nuScenes, the index; default: DATA_ROOT/.fcos_lidar, for
    nuScenes DATA_ROOT/.fcos_lidar/VERSION."""
    splits: Path | None = None
    """JSON file with own splits: {name: [scene, ...]} for nuScenes, {name: [frame, ...]} for a folder."""
    class_map: Path | None = None  # JSON file {name in the data: name to use, or null for objects to leave out}.
    follow_links: bool = False  # Read files to which links lead outside of DATA_ROOT.
    allow_missing_sweeps: bool = False  # nuScenes: use fewer sweeps where files of older sweeps are missing.

    def find(self) -> DataSet:
        return find_data_set(self.data_root, self.format, self.version)

    def split(self, purpose: Literal["train", "val"], *, required: bool = True) -> str | None:
        return default_split(self.find(), purpose, required=required, splits=self.splits)

    def open(
        self,
        config: Config,
        *,
        split: str | None,
        samples: str | None = None,
        sensor: Sensor | None = None,
        option: str = "--samples",
    ) -> FrameSet:
        """Frames for a detector, their labels those of its classes.

        Boxes of other classes are left out; a line on standard error counts them.

        Args:
            config: sweeps, close points and classes.
            split: which part; None for all.
            samples: ranges of the frames, see :func:`parse_ranges`, as given by ``option``; None for all.
            sensor: for layouts that do not define theirs; default: the configuration's.
        """
        frames = self.open_whole(split, config.reading, sensor or load_sensor(config.sensor))
        if samples is not None:
            frames = SelectedFrames(frames, tuple(parse_ranges(samples, len(frames), option)))
        mapped = MappedFrames(frames, config.classes)
        if lost := mapped.left_out() if set(frames.classes) - set(config.classes) else {}:
            counts = ", ".join(f"{count} {name}" for name, count in lost.items())
            tell(f"boxes of classes that the detector does not have are left out: {counts}")
        return mapped

    def open_whole(
        self, split: str | None, reading: CloudReading, sensor: Sensor | None = None, *, missing: bool = True
    ) -> FrameSet:
        """Frames with all of their own classes; the sensor is for data that do not say theirs.

        With ``missing`` a line on standard error counts the sweeps whose file is missing.
        """
        data = self.find()
        frames = open_frames(
            self.data_root,
            format=data.reader.name,
            version=data.version or None,
            split=split,
            sensor=data.reader.sensor and sensor,
            reading=reading,
            class_map=read_class_map(self.class_map),
            index=self.index if data.tables else None,
            splits=self.splits,
            allow_missing_sweeps=self.allow_missing_sweeps,
            follow_links=self.follow_links,
        )
        if missing and isinstance(frames, NuScenesFrames):
            number = frames.nuscenes.missing_sweeps(list(frames.tokens), reading.num_sweeps)
            if number:
                tell(f"{number} sweep files of split {split!r} are missing")
        return frames


def read_class_map(file: Path | None) -> ClassMap | None:
    """The translation of class names in a JSON file; None for none.

    Raises:
        ValueError: naming the file.
    """
    if file is None:
        return None
    return read_json(file, dict[str, str | None], what="a translation of class names")


def parse_ranges(text: str, number: int, option: str = "--samples") -> list[int]:
    """Indices of ``FIRST:LAST[,FIRST:LAST...]``: ranges of ``number`` frames in any order, without their ends.

    Raises:
        ValueError: naming the option and the range that is malformed, out of bounds or overlaps.

    >>> parse_ranges("0:2,5:7", 7)
    [0, 1, 5, 6]
    """
    found: list[int] = []
    for part in text.split(","):
        first, colon, last = part.partition(":")
        if not (colon and first.strip().isdecimal() and last.strip().isdecimal()):
            raise ValueError(f"{option}: got {part!r}, expected FIRST:LAST")
        indices = range(int(first), int(last))
        if not indices or int(last) > number:
            raise ValueError(f"{option}: got {part!r}, expected FIRST < LAST within the {number} frames")
        if set(indices) & set(found):
            raise ValueError(f"{option}: {part!r} overlaps with another range of {text!r}")
        found += indices
    return found
