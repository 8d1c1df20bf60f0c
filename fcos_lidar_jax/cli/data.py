"""The options that select a data set."""

import dataclasses
import functools
import re
from pathlib import Path
from typing import Annotated, Literal, get_args

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import exit_without
from fcos_lidar_jax.cli.options import option
from fcos_lidar_jax.config import CloudReading, Config
from fcos_lidar_jax.data.class_mapping import ClassMap, MappedFrames
from fcos_lidar_jax.data.frame import FrameSet, SelectedFrames
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import read_json, refusing
from fcos_lidar_jax.input_pipeline.open import (
    CLASS_MAPS,
    DataSet,
    Format,
    MissingRootError,
    Reader,
    default_split,
    find_data_set,
    open_frames,
)
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor, load_sensor

_PASSED_ON = ("splits", "allow_missing_sweeps", "follow_links", "full_turn", "intensity_scale")
_FORMATS = f"{{{','.join(get_args(Format))}}}"


@dataclasses.dataclass(frozen=True)
class DataOptions:
    """Options that select a data set."""

    data_root: Annotated[Path | None, option("DIR")] = None
    """Folder of the data set. Leave it out for --format simulated."""
    format: Annotated[Format | None, option(_FORMATS, default="recognised")] = None  # Layout of the data set.
    version: Annotated[str | None, option("NAME", default="the only one")] = None
    """nuScenes: folder of the tables, such as v1.0-trainval."""
    index: Annotated[Path | None, option("DIR", default="DATA_ROOT/.fcos_lidar[/VERSION]")] = None
    """Folder that `fcos-lidar prepare` writes: the objects and, for nuScenes, the index."""
    splits: Annotated[Path | None, option("FILE", default="the splits of the data")] = None
    """JSON file with custom splits: {name: [scene, ...]} for nuScenes, {name: [frame, ...]} for a folder."""
    class_map: Annotated[str | None, option("NAME|FILE")] = None
    """Rename classes: nuscenes for KITTI and Argoverse 2, kitti for nuScenes and simulated frames, or a JSON file:
    {name in the data: new name, or null to leave out its objects}."""
    full_turn: options.FullTurn = False
    intensity_scale: options.IntensityScale = None
    follow_links: bool = False  # Follow links that lead out of DATA_ROOT.
    allow_missing_sweeps: bool = False  # nuScenes: use fewer sweeps if files of older sweeps are missing.

    @functools.cached_property
    def data_set(self) -> DataSet:
        try:
            return find_data_set(self.data_root, self.format, self.version)
        except MissingRootError:
            exit_without("--data-root")

    def split(self, purpose: Literal["train", "val"], given: str | None, *, required: bool = True) -> str | None:
        """The given split, or the default for a purpose."""
        if given is not None:
            return given
        return default_split(self.data_set, purpose, required=required, splits=self.splits)

    def refuse_index(self, why: str) -> None:
        """Reject --index where it would be ignored."""
        if self.index is not None:
            raise ValueError(f"--index: got {self.index}, expected none: {why}")

    def open(
        self,
        config: Config,
        *,
        split: str | None,
        samples: str | None = None,
        sensor: Sensor | None = None,
        option: str = "--samples",
    ) -> MappedFrames:
        """Open frames whose labels index the classes of a configuration.

        Boxes of other classes are left out. A line on standard error names these classes, with counts for data on
        disk. ``samples``, from ``option``, are ranges of the split's frames, see :func:`parse_ranges`. ``sensor``
        is for formats that do not define one, by default the configuration's.
        """
        frames = self.open_whole(split, config.reading, sensor or load_sensor(config.sensor))
        if samples is not None:
            frames = SelectedFrames(frames, tuple(parse_ranges(samples, len(frames), option)))
        with refusing("", ValueError, more=f"; {self.data_set.reader.named_maps}"):
            mapped = MappedFrames(frames, config.classes)
        if missing := [name for name in frames.classes if name not in config.classes]:
            if self.data_set.on_disk:  # To count the boxes of simulated frames, all would have to be simulated.
                missing = [f"{count} {name}" for name, count in mapped.left_out().items()]
            if missing:
                tell(f"left out boxes of classes that the detector does not have: {', '.join(missing)}")
        return mapped

    def open_whole(
        self,
        split: str | None,
        reading: CloudReading,
        sensor: Sensor | None = None,
        *,
        report_missing: bool = True,
    ) -> FrameSet:
        """Open frames with the classes of the data; ``sensor`` is for formats that do not define one.

        With ``report_missing`` a line on standard error counts the missing sweep files, if they may be missing.
        """
        data = self.data_set
        frames = open_frames(
            self.data_root,
            format=data.reader.name,
            version=data.version or None,
            split=split,
            sensor=data.reader.sensor and sensor,
            reading=reading,
            class_map=read_class_map(self.class_map, data.reader),
            index=self.index if data.tables else None,
            **{name: getattr(self, name) for name in _PASSED_ON},
        )
        if report_missing and self.allow_missing_sweeps and isinstance(frames, NuScenesFrames):
            number = frames.nuscenes.missing_sweeps(list(frames.tokens), reading.num_sweeps)
            if number:
                tell(f"{number} sweep files of split {split!r} are missing")
        return frames


def read_class_map(given: str | None, reader: Reader) -> ClassMap | str | None:
    """Read a JSON file that renames classes; the name of a class map stays, and so does None.

    A file that is called like a class map must be given with its folder, such as ``./nuscenes``.
    """
    if given is None or given in CLASS_MAPS:
        return given
    what = f"a translation of class names or one of {reader.named_maps}"
    return read_json(Path(given), dict[str, str | None], what=what)


def parse_ranges(text: str, number: int, option: str = "--samples") -> list[int]:
    """Indices of ``FIRST:LAST[,FIRST:LAST...]``: ranges of ``number`` frames in any order, ``LAST`` excluded.

    >>> parse_ranges("0:2,5:7", 7)
    [0, 1, 5, 6]
    """
    indices: list[int] = []
    for part in text.split(","):
        ends = re.fullmatch(r"\s*(\d+)\s*:\s*(\d+)\s*", part)
        new = range(int(ends[1]), int(ends[2])) if ends else range(0)
        fits = new.stop <= number and len(new) > 0 and not set(new) & set(indices)
        check(fits, option, part, f"FIRST:LAST with FIRST < LAST within the {number} frames, without overlap")
        indices += new
    return indices
