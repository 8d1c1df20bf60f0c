"""Point files without boxes, as frames for detection."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.frame import Frame, FrameSet, drop_close, files_fingerprint, unlabelled
from fcos_lidar_jax.data.kitti import camera_calibration, in_camera
from fcos_lidar_jax.data.point_files import ENDINGS, MAX_POINTS, read_points
from fcos_lidar_jax.data.sweeps import read_list, read_sweeps
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class CloudFiles(FrameSet):
    """Clouds without boxes, from point files or lists of sweeps."""

    files: tuple[Path, ...]  # one per frame: a point file for read_points, or a .json list for read_sweeps
    sensor: Sensor
    reading: CloudReading = CloudReading()
    columns: int | None = None  # of raw files in another layout
    dtype: str | None = None  # of raw files in another layout
    max_points: int = MAX_POINTS  # larger clouds are refused
    full_turn: bool = False  # keep the points of KITTI's files outside the camera image
    viewpoint: bool = False  # of .pcd files: apply it
    classes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.files)

    def frame(self, index: int) -> Frame:
        file = self.files[index]
        layout = {name: getattr(self, name) for name in ("columns", "dtype", "max_points", "viewpoint")}
        if file.suffix == ".json":
            points, num_close = read_sweeps(file, self.sensor, self.reading, **layout)
        else:
            how = {"full_turn": self.full_turn, **layout}
            points, num_close = read_cloud(file, self.sensor, self.reading, **how)
        return unlabelled(points, num_close)

    def name(self, index: int) -> str:
        return str(self.files[index])

    def sources(self, index: int) -> list[Path]:
        """The files on which the points of a frame depend, absolute: with its sweeps, or its calibration."""
        file = self.files[index].absolute()
        if file.suffix == ".json":
            return [file, *(file.parent / sweep.file for sweep in read_list(file))]
        calibration = None if self.full_turn else camera_calibration(file)
        return [file] if calibration is None else [file, calibration]

    def fingerprint(self) -> str:
        """Checksum of the options of reading; :meth:`clouds_fingerprint` is the checksum of the files' states."""
        reading = self.sensor, self.reading, self.columns, self.dtype, self.full_turn, self.viewpoint
        return checksum(repr(reading).encode())

    def clouds_fingerprint(self, indices: Iterable[int]) -> str:
        return files_fingerprint({file for i in indices for file in self.sources(i)}, Path("/"), None)


def read_cloud(
    file: str | Path, sensor: Sensor, reading: CloudReading, *, full_turn: bool = False, **layout: Any
) -> tuple[np.ndarray, int]:
    """Read a point file without the points on the ego vehicle; also returns their number.

    KITTI's files are cropped by :func:`~fcos_lidar_jax.data.kitti.in_camera`, unless ``full_turn``. ``layout`` are
    options of :func:`~fcos_lidar_jax.data.point_files.read_points`.
    """
    points = read_points(file, sensor, num_sweeps=reading.num_sweeps, **layout)
    return drop_close(points if full_turn else in_camera(Path(file), points), sensor, reading)


def find_clouds(inputs: tuple[Path, ...]) -> tuple[Path, ...]:
    """Replace folders by their point files, at least one, sorted by name, without hidden files."""
    clouds: list[Path] = []
    for path in inputs:
        if not path.is_dir():
            clouds.append(path)
            continue
        visible = (file for file in path.iterdir() if file.is_file() and not file.name.startswith("."))
        files = sorted(file for file in visible if file.name.lower().endswith(ENDINGS))
        if not files:
            raise ValueError(f"{path}: no point file in it, expected {', '.join(ENDINGS)}")
        clouds += files
    return tuple(clouds)
