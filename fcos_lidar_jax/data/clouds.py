"""Point files without boxes, as frames to detect in."""

import dataclasses
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.frame import Frame, FrameSet, files_fingerprint
from fcos_lidar_jax.data.point_files import ENDINGS, PointFileError, read_points
from fcos_lidar_jax.data.sweeps import read_sweeps
from fcos_lidar_jax.projection import remove_close
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class CloudFiles(FrameSet):
    """Clouds of point files, or of lists of sweeps to fuse, without boxes."""

    files: tuple[Path, ...]
    """One a frame: a point file as :func:`~fcos_lidar_jax.data.point_files.read_points` reads it, or a ``.json``
    list as :func:`~fcos_lidar_jax.data.sweeps.read_sweeps` does."""
    sensor: Sensor
    """Whose points they are."""
    remove_close: str = "sweeps"
    """As in :func:`fcos_lidar_jax.projection.remove_close`; of a list, in each sweep's own frame."""
    close_m: float = 1.0
    """Half the side of the square that is emptied."""
    num_sweeps: int | None = None
    """Sweeps of a list that are fused at most; None for all."""
    columns: int | None = None
    """Of a raw file of another layout."""
    dtype: str | None = None
    """Of a raw file of another layout."""
    classes: tuple[str, ...] = ()
    """None: there are no boxes."""

    def __len__(self) -> int:
        """Number of files."""
        return len(self.files)

    def frame(self, index: int) -> Frame:
        """One cloud."""
        file = self.files[index]
        if file.suffix == ".json":
            points, num_close = read_sweeps(
                file,
                self.sensor,
                remove_close=self.remove_close,
                close_m=self.close_m,
                num_sweeps=self.num_sweeps,
            )
        else:
            cloud = read_points(file, self.sensor, columns=self.columns, dtype=self.dtype)
            everything = np.ones(len(cloud), bool)
            kept = remove_close(cloud, everything, self.sensor, mode=self.remove_close, close_m=self.close_m)
            points = cloud[np.asarray(kept)]
            num_close = len(cloud) - len(points)
        none = np.zeros(0, np.int32)
        return Frame(points, np.zeros((0, 9), np.float32), none, none, num_close)

    def labels(self, index: int) -> np.ndarray:
        """No labels."""
        return np.zeros(0, np.int32)

    def name(self, index: int) -> str:
        """The file."""
        return str(self.files[index])

    def fingerprint(self) -> str:
        """Of the files' names, sizes and times."""
        reading = self.remove_close, self.close_m, self.num_sweeps, self.columns, self.dtype
        return files_fingerprint([file.absolute() for file in self.files], Path("/"), reading)


def find_clouds(inputs: tuple[Path, ...]) -> tuple[Path, ...]:
    """Point files, and those in folders, sorted within each folder.

    Args:
        inputs: files and folders.

    Raises:
        PointFileError: a folder without a point file.
    """
    found: list[Path] = []
    for path in inputs:
        if not path.is_dir():
            found.append(path)
            continue
        files = sorted(p for p in path.iterdir() if p.is_file() and p.name.lower().endswith(ENDINGS))
        if not files:
            raise PointFileError(f"{path}: no point file in it, expected {', '.join(ENDINGS)}")
        found += files
    return tuple(found)
