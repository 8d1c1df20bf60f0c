"""The object database for copy-paste: points of single objects, cut from annotated clouds.

A folder of shards, one a scene, and a manifest. A shard is two files: ``NAME.points.f32``, the points of its
objects one behind another as plain float32, and ``NAME.objects.npz``, a table that says where each object's points
are and holds their checksum. ``manifest.json``, written last, holds the checksum of every table. So opening reads
the small tables alone and sees every altered table and every cut-off file; an altered point is seen when its
object is read.
"""

import dataclasses
import hashlib
import io
import zipfile
import zlib
from pathlib import Path

import msgspec
import numpy as np

from fcos_lidar_jax.types import CLASSES

FORMAT, VERSION = "fcos_lidar_jax objects", 1
MANIFEST = "manifest.json"

ROW = np.dtype(
    [
        ("box", "<f4", (9,)),  # x, y, z, l, w, h, yaw, vx, vy in the frame it was cut from
        ("label", "<i4"),  # index into types.CLASSES
        ("frame", "<i4"),  # index of the frame it was cut from
        ("start", "<i8"),  # its first row in the shard's points
        ("count", "<i4"),  # its rows, of all sweeps
        ("current", "<i4"),  # those of them with lag 0
        ("crc32", "<u4"),  # of the rows' bytes
    ]
)
"""One object in a shard's table."""


class ObjectDatabaseError(ValueError):
    """The database cannot be used; the message names the file, what was found and what was expected."""


class Shard(msgspec.Struct, forbid_unknown_fields=True):
    """One scene's entry in the manifest."""

    name: str
    objects: int
    points: int
    table_blake2b: str


class Manifest(msgspec.Struct, forbid_unknown_fields=True):
    """The last file to be written: without it a database is not finished."""

    format: str
    version: int
    source: str
    classes: list[str]
    min_points: int
    columns: int
    shards: list[Shard]


class _Header(msgspec.Struct):
    format: str
    version: int


def points_file(folder: Path, shard: str) -> Path:
    """Where a shard's points are."""
    return folder / f"{shard}.points.f32"


def table_file(folder: Path, shard: str) -> Path:
    """Where a shard's table is."""
    return folder / f"{shard}.objects.npz"


def checksum(data: bytes) -> str:
    """BLAKE2b of 16 bytes, in hexadecimal.

    >>> checksum(b"")
    'cae66941d9efbd404e4d88758ea67670'
    """
    return hashlib.blake2b(data, digest_size=16).hexdigest()


@dataclasses.dataclass(frozen=True)
class Table:
    """What a shard's table file holds."""

    rows: np.ndarray
    """:data:`ROW`, one an object."""
    columns: int
    """Of a point; 0 where there was no frame."""
    recipe: str
    """Checksum of all that the shard's bytes follow from."""
    blake2b: str
    """Checksum of the file."""

    @property
    def num_points(self) -> int:
        """Points of all its objects."""
        return int(self.rows["count"].sum(dtype=np.int64))


@dataclasses.dataclass(frozen=True)
class ObjectDatabase:
    """An opened database: the tables in memory, the points on disk."""

    folder: Path
    """Where the shards are."""
    manifest: Manifest
    """What was built."""
    table: np.ndarray
    """:data:`ROW`, all shards one behind another."""
    shard: np.ndarray
    """i32: which shard of the manifest holds each object."""

    def __len__(self) -> int:
        """Number of objects."""
        return len(self.table)

    def points(self, index: int) -> np.ndarray:
        """The points of one object at their original pose, f32[n, c], read anew, current ones first.

        Files are opened for each object, not mapped: a thousand maps would exhaust the open files of a process.

        Raises:
            ObjectDatabaseError: when the bytes are not those that were written.
        """
        row, columns = self.table[index], self.manifest.columns
        file = points_file(self.folder, self.manifest.shards[self.shard[index]].name)
        start, count = int(row["start"]) * columns, int(row["count"]) * columns
        values = np.fromfile(file, "<f4", count=count, offset=4 * start)
        if zlib.crc32(values.data) != row["crc32"]:
            raise ObjectDatabaseError(
                f"{file}: object {index}: checksum differs, expected the bytes that were written; build it anew"
            )
        return values.reshape(-1, columns)


def open_objects(folder: str | Path, *, fingerprint: str | None = None) -> ObjectDatabase:
    """Open and check a database that :func:`fcos_lidar_jax.data.object_builder.build_objects` finished.

    Args:
        folder: of the database.
        fingerprint: of the data that it must have been built from; None to take any.

    Raises:
        ObjectDatabaseError: missing, unfinished, of another format version or other data, altered or cut off.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    if fingerprint is not None and manifest.source != fingerprint:
        raise ObjectDatabaseError(
            f"{folder / MANIFEST}: source: got {manifest.source!r}, expected {fingerprint!r}: built from other "
            f"data, build it anew"
        )
    tables = []
    for entry in manifest.shards:
        table = read_shard(folder, entry.name, expected=entry.table_blake2b)
        found = len(table.rows), table.num_points
        if found != (entry.objects, entry.points):
            raise ObjectDatabaseError(
                f"{folder / MANIFEST}: {entry.name}: got {entry.objects} objects of {entry.points} points, "
                f"expected {found[0]} of {found[1]} as in its table; build it anew"
            )
        tables.append(table.rows)
    sizes = [len(rows) for rows in tables]
    return ObjectDatabase(
        folder,
        manifest,
        np.concatenate(tables) if tables else np.zeros(0, ROW),
        np.repeat(np.arange(len(tables), dtype=np.int32), sizes),
    )


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a finished database.

    Raises:
        ObjectDatabaseError: as :func:`open_objects`.
    """
    file = folder / MANIFEST
    if not file.is_file():
        raise ObjectDatabaseError(f"{file}: no such file, expected a finished object database")
    data = _read(file)
    try:
        header = msgspec.json.decode(data, type=_Header)
        if (header.format, header.version) != (FORMAT, VERSION):
            raise ObjectDatabaseError(
                f"{file}: got {header.format!r} version {header.version}, expected {FORMAT!r} version {VERSION}; "
                f"build it anew"
            )
        manifest = msgspec.json.decode(data, type=Manifest)
    except msgspec.DecodeError as error:
        raise ObjectDatabaseError(f"{file}: {error}") from None
    if tuple(manifest.classes) != CLASSES:
        raise ObjectDatabaseError(f"{file}: classes: got {manifest.classes}, expected {list(CLASSES)}")
    return manifest


def read_shard(folder: Path, name: str, *, expected: str | None = None) -> Table:
    """A shard's table, its points being as many as it says.

    Args:
        folder: of the database.
        name: of the shard.
        expected: checksum of the table; None to take any.

    Raises:
        ObjectDatabaseError: there is no such shard, or not a whole one, or another one.
    """
    file = table_file(folder, name)
    data = _read(file)
    found = checksum(data)
    if expected is not None and found != expected:
        raise ObjectDatabaseError(f"{file}: checksum differs from the manifest's; build it anew")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            table = Table(arrays["rows"], int(arrays["columns"]), str(arrays["recipe"]), found)
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ObjectDatabaseError(f"{file}: not a table of objects: {error}") from None
    if table.rows.dtype != ROW or table.rows.ndim != 1:
        raise ObjectDatabaseError(f"{file}: got columns {table.rows.dtype.names}, expected {ROW.names}")
    file = points_file(folder, name)
    size = 4 * table.columns * table.num_points
    found = f"{file.stat().st_size} bytes" if file.is_file() else "no file"
    if found != f"{size} bytes":
        raise ObjectDatabaseError(f"{file}: got {found}, expected {size} bytes of points; build it anew")
    return table


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ObjectDatabaseError(f"{file}: {error.strerror}, expected a part of an object database") from None
