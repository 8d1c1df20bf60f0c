"""The official JSON tables, read as streams of validated rows.

Two tables of the full data set have 2.6 million rows, of which one in eight is needed. Tables are decoded in
pieces, so that only one piece at a time is in memory as objects.
"""

import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from types import GenericAlias
from typing import Annotated, ClassVar, TypeVar

import msgspec

from fcos_lidar_jax.data.box_geometry import LIMITS

_Count = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
_Length = Annotated[float, msgspec.Meta(gt=0, le=LIMITS["l"])]  # metres
_Time = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]  # microseconds
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z

_PIECE_BYTES = 1 << 24
_BETWEEN_ROWS = re.compile(rb"\}(\s*),(\s*)\{")


class Row(msgspec.Struct, gc=False):
    """A row of a table."""

    file: ClassVar[str]  # name of the table's file
    token: str


class Category(Row):
    """A kind of objects."""

    file = "category.json"
    name: str


class Attribute(Row):
    """What an object is doing."""

    file = "attribute.json"
    name: str


class SensorRow(Row):
    """A sensor."""

    file = "sensor.json"
    channel: str


class CalibratedSensor(Row):
    """A sensor's pose on the vehicle: sensor to ego."""

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
    """One object in a scene."""

    file = "instance.json"
    category_token: str


class EgoPose(Row):
    """A pose of the ego vehicle: ego to global."""

    file = "ego_pose.json"
    translation: Vector
    rotation: Quaternion


class SampleData(Row):
    """A file of a sensor."""

    file = "sample_data.json"
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    timestamp: _Time
    is_key_frame: bool
    filename: str
    prev: str


class SampleAnnotation(Row):
    """A box in the global frame; its size is width, length, height."""

    file = "sample_annotation.json"
    sample_token: str
    instance_token: str
    attribute_tokens: tuple[str, ...]
    translation: Vector
    size: tuple[_Length, _Length, _Length]
    rotation: Quaternion
    prev: str
    next: str
    num_lidar_pts: _Count
    num_radar_pts: _Count


R = TypeVar("R", bound=Row)

TABLES: tuple[type[Row], ...] = tuple(Row.__subclasses__())
"""The tables that a LiDAR detector needs, of thirteen."""


def read_table(folder: Path, kind: type[R], *, piece_bytes: int = _PIECE_BYTES) -> Iterator[list[R]]:
    """Read the rows of a table in order, in pieces of about ``piece_bytes`` of text."""
    path = folder / kind.file
    if not path.is_file() or not path.stat().st_size:
        raise ValueError(f"{path}: no such file, or an empty one, expected the table")
    decoder = msgspec.json.Decoder[list[R]](GenericAlias(list, kind))
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text:
        num_rows = 0
        for first, last in _pieces(text, piece_bytes):
            piece = (b"" if first == 0 else b"[") + text[first:last] + (b"" if last == len(text) else b"]")
            rows = _decode(path, decoder, piece, num_rows)
            num_rows += len(rows)
            yield rows


def _pieces(text: mmap.mmap, size: int) -> Iterator[tuple[int, int]]:
    """Spans of whole rows. Rows are flat objects, so ``}, {`` separates them."""
    first = 0
    while first + size < len(text):
        between = _BETWEEN_ROWS.search(text, first + size)  # type: ignore[arg-type]
        if between is None:
            break
        yield first, between.start() + 1
        first = between.end() - 1
    yield first, len(text)


def _decode(path: Path, decoder: msgspec.json.Decoder, piece: bytes, first_row: int) -> list:
    try:
        return decoder.decode(piece)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        problem = re.sub(r"\$\[(\d+)\]", lambda match: f"$[{int(match[1]) + first_row}]", str(error))
        raise ValueError(f"{path}: from row {first_row} on: {problem}") from None
