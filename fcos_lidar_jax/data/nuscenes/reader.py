"""nuScenes: keyframes with fused sweeps and boxes in the LiDAR frame, from the official tables."""

import dataclasses
import functools
import os
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.frame import Frame, FrameSet, files_fingerprint, no_points
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import Index, column_checksums, default_index, has_index, open_index
from fcos_lidar_jax.data.nuscenes.names import label_of
from fcos_lidar_jax.data.nuscenes.splits import scenes_of_split
from fcos_lidar_jax.data.point_files import MAX_POINTS, check_inside
from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.fields import check_name
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.geometry import pose_matrix, rotation_matrix, wrap_angle
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor

_COLUMNS = 5  # x, y, z, intensity, ring: float32 each


@dataclasses.dataclass(frozen=True)
class Boxes:
    """The boxes of one keyframe in its LiDAR frame, only the ten classes, unpadded."""

    boxes: np.ndarray  # f32[m, 9]: x, y, z, l, w, h, yaw, vx, vy; NaN for unknown velocities
    labels: np.ndarray  # i32[m]: index into NUSCENES_CLASSES
    num_lidar_pts: np.ndarray  # i32[m]: points of the current sweep inside, counted with the full rotation
    attributes: tuple[str, ...]  # attribute name of every box, '' for no attribute
    tokens: tuple[str, ...]  # annotation token of every box


class NuScenes:
    """One version of nuScenes, or of any data set in its layout.

    Opens the index of ``fcos-lidar prepare``, or reads the tables if there is no index. Immutable; threads and
    processes may share it.

    Args:
        root: contains the version's folder, ``samples/`` and ``sweeps/``.
        version: the folder of the tables, such as ``v1.0-trainval``.
        index: folder of the index; default: ``ROOT/.fcos_lidar/VERSION``.
        allow_missing_sweeps: skip older sweeps with a missing file instead of refusing them;
            :meth:`missing_sweeps` counts them. Keyframes to detect in are never skipped.
        follow_links: also read files outside the root to which links lead.

    Raises:
        ValueError: with the file, the record, the field, the found and the expected value.

    >>> import tempfile
    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
    >>> from fcos_lidar_jax.simulation.render import DatasetSpec
    >>> toy = DatasetSpec(scenes=1, seed=0, keyframes=1, sensor=TINY, rolling_shutter=False, version="v1.0-toy")
    >>> with tempfile.TemporaryDirectory() as root:
    ...     written = write_dataset(toy, Path(root), workers=1, report=lambda sweeps: None)
    ...     keyframes = NuScenes(root, "v1.0-toy")
    ...     keyframes.sweeps(keyframes.sample_tokens[0]).shape[1]
    5
    """

    def __init__(
        self,
        root: str | Path,
        version: str,
        *,
        index: str | Path | None = None,
        allow_missing_sweeps: bool = False,
        follow_links: bool = False,
    ) -> None:
        self.root, self.version, self.allow_missing_sweeps = Path(root), version, allow_missing_sweeps
        self.follow_links = follow_links
        folder = default_index(root, version) if index is None else Path(index)
        known = index is not None or has_index(folder)
        self.index: Index = open_index(folder, tables=self.tables) if known else build_index(self.tables)
        self._sample_row = {token.decode(): i for i, token in enumerate(self.index.sample_token)}
        self._label = np.array([label_of(str(name)) for name in self.index.category_name], np.int32)

    @property
    def tables(self) -> Path:
        return self.root / self.version

    @property
    def sample_tokens(self) -> list[str]:
        """All keyframes by scene and time."""
        return list(self._sample_row)

    def split(self, name: str, *, file: str | Path | None = None) -> list[str]:
        """The keyframes of a split by scene and time; unknown splits and scenes are refused.

        ``file`` is ``{"name": ["scene", ...]}``; default: the version's ``splits.json``, or the official splits.

        Raises:
            ValueError: no such split, an unknown scene, or no keyframe.
        """
        row = {str(scene): i for i, scene in enumerate(self.index.scene_name)}
        scenes = scenes_of_split(name, self.tables, row, file=file)
        selected = np.isin(self.index.sample_scene, [row[scene] for scene in scenes])
        tokens = [token for token, yes in zip(self._sample_row, selected, strict=True) if yes]
        if not tokens:
            raise ValueError(f"{self.tables}: split {name!r}: got no keyframe, expected at least one")
        return tokens

    def scene_of(self, sample_token: str) -> str:
        return str(self.index.scene_name[self.index.sample_scene[self._sample_row[sample_token]]])

    def sweeps(self, sample_token: str, num: int = 10) -> np.ndarray:
        """The latest ``num`` sweeps up to a keyframe, fused in its LiDAR frame like in the official devkit.

        The current sweep comes first, then the others by age; there are fewer at the start of a scene. Points on
        the ego vehicle, ``|x|, |y| < 1`` m in each sweep's own frame, are dropped.

        Returns:
            f32[n, 5]: x, y, z, intensity (0-255), time lag in seconds, exactly 0 for the current sweep.

        Raises:
            ValueError: a file is missing, truncated, empty, or outside the data root.
        """
        return self.fuse_sweeps(sample_token, CloudReading(num, "all"))[0]

    def fuse_sweeps(
        self, sample_token: str, reading: CloudReading, sensor: Sensor = NUSCENES_HDL32E
    ) -> tuple[np.ndarray, int]:
        """:meth:`sweeps` with another reading; also returns the number of dropped points on the ego vehicle."""
        current, *older = self._chain(self._sweep(sample_token), reading.num_sweeps)
        return fuse_sweeps(map(self._read, [current, *self._present(older)]), sensor, reading)

    def drive(self, scene: str, *, keyframes: bool = False) -> Iterator[Sweep]:
        """The sweeps (or only keyframes) of a scene in temporal order, read on demand.

        With ``allow_missing_sweeps``, sweeps without a file are skipped, but never a keyframe.

        Raises:
            ValueError: no such scene, the message lists the scenes; or a file cannot be read, before the first is.
        """
        own = self._keyframe_rows(scene)
        rows = own if keyframes else self._present(self._scene_rows(scene), keep=own)
        for row in rows:
            self._expect_file(row)
        return map(self._read, rows)

    def skipped_sweeps(self, scene: str) -> tuple[int, int]:
        """Number of sweeps that :meth:`drive` skips in a scene, and number of all its sweeps."""
        rows, own = self._scene_rows(scene), self._keyframe_rows(scene)
        return len(rows) - len(self._present(rows, keep=own)), len(rows)

    def keyframe_tokens(self, scene: str) -> dict[int, str]:
        """Time of a scene's keyframes -> sample token; errors as in :meth:`drive`."""
        tokens = dict(zip(self.index.sample_sweep.tolist(), self._sample_row, strict=True))
        return {int(self.index.sweep_time_us[row]): tokens[row] for row in self._keyframe_rows(scene)}

    def _keyframe_rows(self, scene: str) -> list[int]:
        names = self.index.scene_name.astype(str).tolist()
        check_name(f"{self.tables}: scene", scene, names)
        rows = self.index.sample_sweep[self.index.sample_scene == names.index(scene)].tolist()
        if not rows:
            raise ValueError(f"{self.tables / 'sample.json'}: scene {scene}: found no keyframe, expected one")
        return rows

    def _scene_rows(self, scene: str) -> list[int]:
        last = self._keyframe_rows(scene)[-1]
        following = {int(before): row for row, before in enumerate(self.index.sweep_previous) if before >= 0}
        while last in following:
            last = following[last]
        return self._chain(last, len(self.index.sweep_file))[::-1]

    def boxes(self, sample_token: str) -> Boxes:
        """The boxes of the ten classes in the keyframe's LiDAR frame, including boxes without points.

        Boxes are upright in the global frame and slightly tilted in the LiDAR frame. The tilt is lost: yaw is the
        direction of the heading axis after the full rotation.
        """
        index, own = self.index, self.annotations(sample_token)
        labels = self._label[index.box_category[own]]
        rows, labels = own.start + np.flatnonzero(labels >= 0), labels[labels >= 0]
        to_lidar = np.linalg.inv(self.sensor_to_global(sample_token))
        centre = index.box_translation[rows] @ to_lidar[:3, :3].T + to_lidar[:3, 3]
        heading = rotation_matrix(index.box_rotation[rows])[:, :, 0] @ to_lidar[:3, :3].T
        velocity = index.box_velocity[rows] @ to_lidar[:3, :3].T
        yaw = wrap_angle(np.arctan2(heading[:, 1], heading[:, 0]).astype(np.float32))
        size = index.box_size[rows][:, [1, 0, 2]]
        boxes = np.concatenate([centre, size, yaw[:, None], velocity[:, :2]], axis=1).astype(np.float32)
        names = ["", *map(str, index.attribute_name)]
        attributes = tuple(names[i + 1] for i in index.box_attribute[rows])
        tokens = tuple(token.decode() for token in index.box_token[rows])
        return Boxes(boxes, labels, index.box_lidar_points[rows], attributes, tokens)

    def labels(self, sample_token: str) -> np.ndarray:
        """i32[m]: labels of a keyframe's boxes, except boxes known to be empty."""
        own = self.annotations(sample_token)
        labels = self._label[self.index.box_category[own]]
        return labels[(labels >= 0) & (self.index.box_lidar_points[own] != 0)]

    def annotations(self, sample_token: str) -> slice:
        """Rows of a keyframe's annotations of all categories in the index."""
        first, last = self.index.sample_first[self._sample_row[sample_token] :][:2]
        return slice(int(first), int(last))

    def missing_sweeps(self, sample_tokens: list[str], num: int = 10) -> int:
        """Number of missing sweep files of some keyframes, each counted once."""
        files = {file for token in sample_tokens for file in self.sweep_files(token, num)}
        return sum(not os.path.isfile(file) for file in files)

    def incomplete(self, sample_tokens: Iterable[str], num: int = 10) -> dict[str, Path]:
        """Keyframes of which files are missing -> the newest one; links out of the root are refused."""
        inside = functools.cache(lambda place: check_inside(place, self.root, str(place)))

        @functools.cache
        def is_present(row: int) -> bool:
            path = self._path(row)
            found = os.path.isfile(path)
            if found and not self.follow_links:  # looking at every folder only once saves most of the time
                inside(path if path.is_symlink() else path.parent)
            return found

        lost = dict[str, Path]()
        for token in sample_tokens:
            own, *older = self._chain(self._sweep(token), num)
            gone = [row for row in (own, *older) if not is_present(row)]
            if gone and (gone[0] == own or not self.allow_missing_sweeps):
                lost[token] = self._path(gone[0])
        return lost

    def check_files(self, sample_tokens: Collection[str], num: int = 10) -> None:
        """Refuse :meth:`incomplete` keyframes in one line that counts them and names the scenes without any."""
        if not (lost := self.incomplete(sample_tokens, num)):
            return
        own = sum(file == self._path(self._sweep(token)) for token, file in lost.items())
        what = str(own) if own else f"older sweeps of {len(lost)}"
        rest = "" if own else ", or --allow-missing-sweeps for fewer sweeps"
        broken, scenes = (dict.fromkeys(map(self.scene_of, tokens)) for tokens in (lost, sample_tokens))
        if whole := [scene for scene in scenes if scene not in broken]:
            listed = ", ".join(whole[:20]) + ("" if len(whole) <= 20 else f" and {len(whole) - 20} more")
            rest += f", or --splits with a file of whole scenes ({len(whole)} of {len(scenes)}): {listed}"
        found = f"{what} of {len(sample_tokens)} keyframes are missing, such as {next(iter(lost.values()))}"
        raise ValueError(f"{self.root}: {found}: expected the rest of the download{rest}")

    def sweep_files(self, sample_token: str, num: int = 10) -> list[Path]:
        """Files of the sweeps up to a keyframe, the current one first, even if they are missing."""
        return [self._path(row) for row in self._chain(self._sweep(sample_token), num)]

    def sensor_to_global(self, sample_token: str) -> np.ndarray:
        """f64[4, 4] from a keyframe's LiDAR frame to the global frame."""
        return self._sensor_to_global(self._sweep(sample_token))

    def time_us(self, sample_token: str) -> int:
        """Time of a keyframe's own sweep in microseconds."""
        return int(self.index.sweep_time_us[self._sweep(sample_token)])

    def ego_translation(self, sample_token: str) -> np.ndarray:
        """f64[3]: position of the ego vehicle in the global frame."""
        return self.index.ego_translation[self._sweep(sample_token)]

    def _sweep(self, sample_token: str) -> int:
        return int(self.index.sample_sweep[self._sample_row[sample_token]])

    def _chain(self, row: int, num: int) -> list[int]:
        """A sweep and the sweeps before it, at most ``num``."""
        chain = [row]
        while len(chain) < num and (before := int(self.index.sweep_previous[chain[-1]])) >= 0:
            chain.append(before)
        return chain

    def _sensor_to_global(self, row: int) -> np.ndarray:
        index, mount = self.index, self.index.sweep_sensor[row]
        ego = pose_matrix(index.ego_rotation[row], index.ego_translation[row])
        return ego @ pose_matrix(index.sensor_rotation[mount], index.sensor_translation[mount])

    def _path(self, row: int) -> Path:
        return self.root / self.index.sweep_file[row].decode()

    def _present(self, rows: list[int], keep: Collection[int] = ()) -> list[int]:
        """Rows without those to skip: their file is missing, and they are not to be kept."""
        if not self.allow_missing_sweeps:
            return rows
        return [row for row in rows if row in keep or os.path.isfile(self._path(row))]

    def _expect_file(self, row: int) -> Path:
        path = self._path(row)
        if not os.path.isfile(path):
            needed = self.allow_missing_sweeps or row in self.index.sample_sweep  # keyframes are never skipped
            hint = "" if needed else "; --allow-missing-sweeps continues with fewer sweeps"
            raise ValueError(f"{path}: no such file, expected a sweep that sample_data.json names{hint}")
        if not self.follow_links:
            check_inside(path, self.root, str(path))
        return path

    def _read(self, row: int) -> Sweep:
        path = self._expect_file(row)
        size = path.stat().st_size
        if size % (4 * _COLUMNS) or not 0 < size <= 4 * _COLUMNS * MAX_POINTS:
            expected = f"a multiple of {4 * _COLUMNS} (float32 x 5), 1 to {MAX_POINTS} points"
            raise ValueError(f"{path}: got {size} bytes, expected {expected}")
        points = np.fromfile(path, np.float32).reshape(-1, _COLUMNS)
        return Sweep(points, self._sensor_to_global(row), int(self.index.sweep_time_us[row]), str(path))


@dataclasses.dataclass(frozen=True)
class NuScenesFrames(FrameSet):
    """Keyframes of nuScenes as a :class:`fcos_lidar_jax.data.frame.FrameSet`."""

    nuscenes: NuScenes
    tokens: tuple[str, ...]  # keyframes, in order
    reading: CloudReading = CloudReading()
    sensor: Sensor = NUSCENES_HDL32E
    classes = NUSCENES_CLASSES

    def __len__(self) -> int:
        return len(self.tokens)

    def frame(self, index: int) -> Frame:
        points, num_close = self.nuscenes.fuse_sweeps(self.tokens[index], self.reading, self.sensor)
        return dataclasses.replace(self.truth(index), points=points, num_close=num_close)

    def truth(self, index: int) -> Frame:
        boxes = self.nuscenes.boxes(self.tokens[index])
        return Frame(no_points(self.sensor), boxes.boxes, boxes.labels, boxes.num_lidar_pts)

    def labels(self, index: int) -> np.ndarray:
        return self.nuscenes.labels(self.tokens[index])

    def name(self, index: int) -> str:
        return self.tokens[index]

    def pose(self, index: int) -> np.ndarray:
        return self.nuscenes.sensor_to_global(self.tokens[index])

    def time_us(self, index: int) -> int:
        return self.nuscenes.time_us(self.tokens[index])

    def scene(self, index: int) -> str:
        return self.nuscenes.scene_of(self.tokens[index])

    def check_files(self, indices: Iterable[int]) -> None:
        self.nuscenes.check_files([self.tokens[index] for index in indices], self.reading.num_sweeps)

    def clouds_fingerprint(self, indices: Iterable[int]) -> str:
        tokens, number = (self.tokens[index] for index in indices), self.reading.num_sweeps
        files = {file for token in tokens for file in self.nuscenes.sweep_files(token, number)}
        return files_fingerprint(files, self.nuscenes.root, None)

    def fingerprint(self) -> str:
        how = dataclasses.astuple(self.reading)
        return checksum(repr((column_checksums(self.nuscenes.index), self.tokens, how)).encode())


def open_keyframes(
    root: Path,
    version: str,
    split: str | None,
    sensor: Sensor,
    reading: CloudReading,
    *,
    splits: str | Path | None = None,
    **options: Any,
) -> NuScenesFrames:
    """Open the keyframes of a split, or all; ``splits`` is a file of custom splits, ``options`` go to NuScenes."""
    data = NuScenes(root, version, **options)
    tokens = data.sample_tokens if split is None else data.split(split, file=splits)
    return NuScenesFrames(data, tuple(tokens), reading, sensor)
