"""The official JSON tables, read as streams of validated rows.

Two of them have 2.6 million rows in the full data set, of which one in eight is needed: a table is decoded piece
by piece, so that no more than a piece is ever in memory as objects.
"""

import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, TypeVar

import msgspec

_Count = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
_Time = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]  # microseconds
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z

_PIECE_BYTES = 1 << 24
_BETWEEN_ROWS = re.compile(rb"\}(\s*),(\s*)\{")


class TableError(ValueError):
    """A table that cannot be used; the message names the file, the record and the field."""


class Row(msgspec.Struct, gc=False):
    """A row of a table."""

    file: ClassVar[str]  # name of the table's file
    token: str


class Category(Row):
    """What kinds of objects there are."""

    file = "category.json"
    name: str


class Attribute(Row):
    """What objects may be doing."""

    file = "attribute.json"
    name: str


class SensorRow(Row):
    """A sensor."""

    file = "sensor.json"
    channel: str


class CalibratedSensor(Row):
    """Where a sensor is mounted: sensor to ego."""

    file = "calibrated_sensor.json"
    sensor_token: str
    translation: Vector
    rotation: Quaternion


class Scene(Row):
    """A drive of 20 s."""

    file = "scene.json"
    name: str


class Sample(Row):
    """A keyframe."""

    file = "sample.json"
    timestamp: _Time
    scene_token: str


class Instance(Row):
    """One object through a scene."""

    file = "instance.json"
    category_token: str


class EgoPose(Row):
    """Ego to global."""

    file = "ego_pose.json"
    translation: Vector
    rotation: Quaternion


class SampleData(Row):
    """One file of one sensor."""

    file = "sample_data.json"
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    timestamp: _Time
    is_key_frame: bool
    filename: str
    prev: str


class SampleAnnotation(Row):
    """One box in the global frame; size is width, length, height."""

    file = "sample_annotation.json"
    sample_token: str
    instance_token: str
    attribute_tokens: tuple[str, ...]
    translation: Vector
    size: Vector
    rotation: Quaternion
    prev: str
    next: str
    num_lidar_pts: _Count
    num_radar_pts: _Count


R = TypeVar("R", bound=Row)

TABLES: tuple[type[Row], ...] = tuple(Row.__subclasses__())
"""The tables that a LiDAR detector needs, of the thirteen."""


def read_table(folder: Path, kind: type[R], *, piece_bytes: int = _PIECE_BYTES) -> Iterator[list[R]]:
    """The rows of a table in their order, a piece at a time.

    Args:
        kind: one of :data:`TABLES`.
        piece_bytes: a piece is the rows of about so much text.

    Raises:
        TableError: the table is missing, not JSON, or a row has not the fields of ``kind``.
    """
    path = folder / kind.file
    if not path.is_file():
        raise TableError(f"{path}: no such file, expected the table")
    if path.stat().st_size == 0:
        raise TableError(f"{path}: empty file, expected a JSON list")
    decoder = msgspec.json.Decoder(list[kind])
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text:
        seen = 0
        for first, last in _pieces(text, piece_bytes):
            piece = (b"" if first == 0 else b"[") + text[first:last] + (b"" if last == len(text) else b"]")
            rows = _decode(path, decoder, piece, seen, first - (first > 0))
            seen += len(rows)
            yield rows


def _pieces(text: mmap.mmap, size: int) -> Iterator[tuple[int, int]]:
    """Spans of whole rows: rows are flat objects, so they meet at ``}, {``."""
    first = 0
    while first + size < len(text):
        between = _BETWEEN_ROWS.search(text, first + size)  # type: ignore[arg-type]
        if between is None:
            break
        yield first, between.start() + 1
        first = between.end() - 1
    yield first, len(text)


def _decode(path: Path, decoder: msgspec.json.Decoder, piece: bytes, seen: int, offset: int) -> list:
    """A piece's rows; an error tells its place in the whole file."""
    try:
        return decoder.decode(piece)
    except msgspec.ValidationError as error:
        text, _, place = str(error).rpartition(" - at `")
        place = re.sub(r"\$\[(\d+)\]", lambda match: f"$[{int(match[1]) + seen}]", place.rstrip("`"))
        raise TableError(f"{path}: {place or '$'}: {text or error}") from None
    except msgspec.DecodeError as error:
        at = re.search(r"byte (\d+)", str(error))
        place = int(at[1]) if at else len(piece)
        what = re.sub(r" ?\(byte \d+\)", "", str(error))
        raise TableError(f"{path}: byte {place + offset}{_record_at(piece, place)}: not JSON: {what}") from None
    except (UnicodeDecodeError, RecursionError) as error:
        raise TableError(f"{path}: not JSON: {error}") from None


def _record_at(piece: bytes, place: int) -> str:
    """Which record and field a byte belongs to, as far as the text before it tells."""
    row = piece[piece.rfind(b"{", 0, place) + 1 : place]
    tokens = re.findall(rb'"token"\s*:\s*"([^"]*)"', row)
    fields = re.findall(rb'"(\w+)"\s*:', row)
    names = [f"record {t.decode(errors='replace')}" for t in tokens] + [f.decode() for f in fields[-1:]]
    return f" ({', '.join(names)})" if names else ""
