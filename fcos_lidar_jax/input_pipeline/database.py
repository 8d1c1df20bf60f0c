"""The ground-truth database for copy-paste: points of single objects, cut from annotated clouds.

A folder with one shard per scene and a manifest. A shard has two files: ``NAME.points.f32``, the points of all
objects as plain float32, and ``NAME.objects.npz``, a table with the place and checksum of each object's points.
``manifest.json`` is written last and contains the checksum of every table. Opening therefore reads only the small
tables, and detects altered tables and truncated files; altered points are detected when their object is read.
"""

import dataclasses
import re
import zlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import check_boxes, points_in_boxes
from fcos_lidar_jax.data.cloud_policy import unusable_cloud, unusable_clouds, usable_rows
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.npy_files import parse_npz
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import atomic_write, checksum, read_json, refusing
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.workers import run_jobs

MAX_SWEEPS = 20  # number of sweeps for which an object's points are counted

_FORMAT, _VERSION = "fcos_lidar_jax objects", 5
_REBUILD = "rebuild it with fcos-lidar prepare"
_MANIFEST = "manifest.json"
_ROW = np.dtype(
    [
        ("box", "<f4", (9,)),  # x, y, z, l, w, h, yaw, vx, vy in the frame it was cut from
        ("label", "<i4"),  # index into the manifest's classes
        ("frame", "<i4"),  # index of the frame it was cut from
        ("start", "<i8"),  # its first row in the shard's points
        ("count", "<i4"),  # its rows of all sweeps, sorted by age
        ("newest", "<i4", (MAX_SWEEPS,)),  # rows of the newest 1, 2, ... sweeps of the frame
        ("crc32", "<u4"),  # of the rows' bytes
    ]
)
"""One object in a shard's table."""
_BLOCK = 100  # frames per shard if the data have no scenes


class Shard(msgspec.Struct, forbid_unknown_fields=True):
    """One scene's entry in the manifest."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[^/\x00]+$")]  # begins the names of its files
    objects: int
    points: int
    table_blake2b: str


class Manifest(msgspec.Struct, forbid_unknown_fields=True):
    """Marks a finished database: it is written last."""

    format: Annotated[str, msgspec.Meta(pattern=f"^{_FORMAT}$")]
    version: Annotated[int, msgspec.Meta(ge=_VERSION, le=_VERSION)]  # before fields that other versions may lack
    source: str
    classes: list[str]
    min_points: int
    num_sweeps: Annotated[int, msgspec.Meta(ge=1, le=MAX_SWEEPS)]
    columns: int
    shards: list[Shard]


class _Table(NamedTuple):
    rows: np.ndarray  # _ROW, one per object
    recipe: str  # checksum of everything that determines the shard's bytes
    blake2b: str  # checksum of the file
    num_points: int  # of all objects
    unusable: list[str]  # a line about each cloud without usable points
    boxes: np.ndarray  # i64[2]: number of boxes, and of boxes without a point


@dataclasses.dataclass(frozen=True)
class GroundTruthDatabase:
    """An opened database: the tables in memory, the points on disk."""

    folder: Path
    manifest: Manifest
    table: np.ndarray
    """One row per object of all shards: ``box``, ``label`` (index into the manifest's classes), ``frame``, and the
    place of its points."""
    shard: np.ndarray  # i32: index of each object's shard in the manifest

    def __len__(self) -> int:
        return len(self.table)

    def fingerprint(self) -> str:
        """Checksum of all objects; the table contains the checksums of their points."""
        return checksum(repr((self.manifest.classes, self.manifest.columns)).encode() + self.table.tobytes())

    def num_points(self, num_sweeps: int) -> np.ndarray:
        """i32[n]: points of every object in the newest sweeps (at most :data:`MAX_SWEEPS`) of its frame."""
        return self.table["newest"][:, num_sweeps - 1]

    def points(self, index: int) -> np.ndarray:
        """Read one object's points f32[n, c] at their original pose, sorted by age, and verify them.

        Opens the file for each object instead of mapping it: a thousand maps would exhaust a process's open files.
        """
        row, columns = self.table[index], self.manifest.columns
        file, _ = _files(self.folder, self.manifest.shards[self.shard[index]].name)
        start, count = int(row["start"]) * columns, int(row["count"]) * columns
        values = np.fromfile(file, "<f4", count=count, offset=4 * start)
        if zlib.crc32(values.data) != row["crc32"]:
            raise ValueError(f"{file}: object {index}: checksum differs from the table's; {_REBUILD}")
        return values.reshape(-1, columns)


def open_database(folder: str | Path, *, fingerprint: str | None = None) -> GroundTruthDatabase:
    """Open and check a finished ground-truth database of the frames with a ``fingerprint``; None accepts any.

    Missing, unfinished, altered and truncated databases, and databases of another version, are refused.
    """
    folder = Path(folder)
    file = folder / _MANIFEST
    with refusing("", ValueError, more=f"; {_REBUILD}"):
        manifest = read_json(file, Manifest, what="a finished ground-truth database")
    expected = f"{fingerprint!r}: built from other data, {_REBUILD}"
    check(fingerprint in (None, manifest.source), f"{file}: source", manifest.source, expected)
    tables = []
    for entry in manifest.shards:
        tables.append(_read_shard(folder, entry.name, manifest.columns, expected=entry.table_blake2b).rows)
    rows = np.concatenate([np.zeros(0, _ROW), *tables])
    shard = np.repeat(np.arange(len(tables), dtype=np.int32), [len(table) for table in tables])
    return GroundTruthDatabase(folder, manifest, rows, shard)


def cut_reading(num_sweeps: int) -> CloudReading:
    """The reading of the frames from which objects are cut."""
    return CloudReading(num_sweeps, "all")


def objects_folder(index: Path, split: str | None) -> Path:
    """The database folder of a split; splits are separate, so that no validation object enters the training."""
    name = split or "all_frames"
    check(Path(name).name == name != "..", "split", name, "a name that a folder can have")
    return index / "objects" / name


def prepare_database(
    frames: FrameSet,
    folder: str | Path,
    *,
    min_points: int = 5,
    num_sweeps: int = MAX_SWEEPS,
    workers: int = 1,
    report: Callable[[int, int], object] = lambda done, total: None,
) -> GroundTruthDatabase:
    """Cut the points of every box with at least ``min_points`` points over all sweeps, one shard per scene.

    Each shard is written atomically, its table last. A killed build loses only the shards in progress, and
    the next call completes it. The files are bit-identical for any number of workers and interruptions. Shards of
    frames with another fingerprint are replaced.

    Args:
        frames: frames of any classes; must be picklable for several workers.
        folder: contains only the database.
        num_sweeps: maximum number of sweeps that the frames fuse; detectors of more sweeps refuse the objects.
        workers: number of processes; 1 works in this process.
        report: called with (frames done, total) at the start, including frames of an earlier run, and after every
            shard.

    Raises:
        ValueError: more sweeps than :data:`MAX_SWEEPS`, or missing files, before a frame is read; a frame has an
            implausible box; no frame has usable points.
        OSError: an error of the file system, or a worker died.
    """
    folder = Path(folder)
    check(1 <= num_sweeps <= MAX_SWEEPS, "num_sweeps", num_sweeps, f"1 to {MAX_SWEEPS}")
    frames.check_files(range(len(frames)))
    shards, source, columns = shards_by_scene(frames), frames.fingerprint(), frames.sensor.point_columns
    folder.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(folder, shards)
    jobs, done = [], 0
    for name, indices in shards.items():
        follows_from = _FORMAT, _VERSION, tuple(frames.classes), source, min_points, name, indices
        if clouds := frames.clouds_fingerprint(indices):
            follows_from = *follows_from, clouds
        job = _Job(folder, name, indices, min_points, columns, checksum(repr(follows_from).encode()))
        if _finished(job):
            done += len(indices)
        else:
            jobs.append(job)
    if jobs:  # an old manifest would not fit the new shards
        (folder / _MANIFEST).unlink(missing_ok=True)
    report(done, len(frames))
    for count in run_jobs(_cut_shard, frames, jobs, workers):
        done += count
        report(done, len(frames))
    tables = {name: _read_shard(folder, name, columns) for name in shards}
    _tell_found(tables, len(frames), min_points)
    entries = [Shard(name, len(t.rows), t.num_points, t.blake2b) for name, t in tables.items()]
    classes = list(frames.classes)
    manifest = Manifest(_FORMAT, _VERSION, source, classes, min_points, num_sweeps, columns, entries)
    atomic_write(folder / _MANIFEST, msgspec.json.format(msgspec.json.encode(manifest), indent=1))
    return open_database(folder, fingerprint=source)


def _remove_leftovers(folder: Path, shards: Collection[str]) -> None:
    """Remove partial files of a killed run, and shards of scenes that are gone."""
    for file in folder.iterdir():
        shard = re.sub(r"\.(points\.f32|objects\.npz)$", "", file.name)
        left_over = re.fullmatch(r"\.[0-9a-f]{12}\.(f32|npz|json)", file.name)
        if left_over or (shard != file.name and shard not in shards):
            file.unlink()


def _tell_found(tables: dict[str, _Table], num_frames: int, min_points: int) -> None:
    unusable = [line for table in tables.values() for line in table.unusable]
    if line := unusable_clouds(unusable, num_frames, without="objects"):
        tell(f"note: {line}")
    num_boxes, num_empty = sum((table.boxes for table in tables.values()), np.zeros(2, np.int64))
    tell(f"{num_boxes} boxes, {sum(len(t.rows) for t in tables.values())} with at least {min_points} points")
    if num_empty > num_boxes / 2:
        found = f"{num_empty} of {num_boxes} boxes contain no point, expected few"
        tell(f"warning: {found}: are points and boxes in the same frame?")


def shards_by_scene(frames: FrameSet) -> dict[str, list[int]]:
    """Shard -> indices of its frames; named after the scene, or the first frame if the data have no scenes."""
    shards: dict[str, list[int]] = {}
    for index in range(len(frames)):
        scene = re.sub(r"[^\w.-]|^[.-]", "_", frames.scene(index))
        shards.setdefault(scene or f"frames_{index // _BLOCK * _BLOCK:06d}", []).append(index)
    return shards


class _Job(NamedTuple):
    folder: Path
    name: str
    indices: list[int]
    min_points: int
    columns: int
    recipe: str


def _files(folder: Path, shard: str) -> tuple[Path, Path]:
    return folder / f"{shard}.points.f32", folder / f"{shard}.objects.npz"


def _finished(job: _Job) -> bool:
    """Whether an earlier run completed the shard, including every point."""
    try:
        table = _read_shard(job.folder, job.name, job.columns)
    except ValueError:
        return False
    if table.recipe != job.recipe:
        return False
    data, size = memoryview(_files(job.folder, job.name)[0].read_bytes()), 4 * job.columns
    starts, counts = (table.rows[field].tolist() for field in ("start", "count"))
    checksums = [zlib.crc32(data[size * i : size * (i + n)]) for i, n in zip(starts, counts, strict=True)]
    return checksums == table.rows["crc32"].tolist()


def _cut_shard(frames: FrameSet, job: _Job) -> int:
    rows: list[tuple] = []
    parts: list[np.ndarray] = []
    unusable: list[str] = []
    num_boxes, start = np.zeros(2, np.int64), 0
    for index in job.indices:
        frame = frames.frame(index)
        check_boxes(frame.boxes, lambda box, index=index: f"frame {frames.name(index)!r}: box {box}")
        usable = np.asarray(usable_rows(frame.points))
        if line := unusable_cloud(frames.name(index), frame.points, usable, frame.num_close, frames.sensor):
            unusable.append(line)
        cloud = frame.points[usable]
        lags = np.unique(np.append(cloud[:, 4], np.float32(0)))[:MAX_SWEEPS]
        for box, label, inside in zip(frame.boxes, frame.labels, points_in_boxes(cloud, frame.boxes), strict=True):
            num_boxes += 1, not len(inside)
            if len(inside) < job.min_points:
                continue
            points = cloud[inside]
            points = np.ascontiguousarray(points[np.argsort(points[:, 4], kind="stable")], "<f4")
            newest = np.searchsorted(points[:, 4], lags, side="right")
            newest = np.pad(newest, (0, MAX_SWEEPS - len(lags)), mode="edge")
            rows.append((box, label, index, start, len(points), newest, zlib.crc32(points.data)))
            parts.append(points)
            start += len(points)
    table = {"rows": np.array(rows, _ROW), "recipe": np.array(job.recipe), "unusable": np.array(unusable, str)}
    table["boxes"] = num_boxes
    points = np.concatenate([np.zeros((0, job.columns), "<f4"), *parts])
    points_file, table_file = _files(job.folder, job.name)
    atomic_write(points_file, points.tobytes())  # errors of tofile lack their errno
    atomic_write(table_file, lambda path: np.savez(path, allow_pickle=False, **table))
    return len(job.indices)


def _read_shard(folder: Path, name: str, columns: int, *, expected: str | None = None) -> _Table:
    """Read and check a shard's table and the size of its points; ``expected`` is the table's checksum."""
    points_file, file = _files(folder, name)
    with refusing(f"{file}: not a table of objects", OSError, ValueError, more=f"; {_REBUILD}"):
        data = file.read_bytes()
        arrays = parse_npz(data, ["rows", "recipe", "unusable", "boxes"])
    digest, rows = checksum(data), arrays["rows"]
    if expected not in (None, digest) or rows.dtype != _ROW:
        raise ValueError(f"{file}: got another table than the manifest's; {_REBUILD}")
    num_points, unusable = int(rows["count"].sum(dtype=np.int64)), [*map(str, arrays["unusable"].flat)]
    table = _Table(rows, str(arrays["recipe"]), digest, num_points, unusable, arrays["boxes"])
    size = 4 * columns * table.num_points
    found = f"{points_file.stat().st_size} bytes" if points_file.is_file() else "no file"
    if found != f"{size} bytes":
        raise ValueError(f"{points_file}: got {found}, expected {size} bytes of points; {_REBUILD}")
    return table
