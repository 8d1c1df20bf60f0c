"""PCD files: ascii, binary and binary_compressed."""

import contextlib
import dataclasses
import math
import re
from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.files import refusing
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.progress import tell

_COLUMNS: dict[str, tuple[str, ...]] = {name: (name,) for name in ("x", "y", "z", "time_lag")}
_COLUMNS["intensity"] = ("reflectivity", "intensity", "intensities", "remission", "scalar_intensity", "i")
_COLUMNS["laser"] = ("laser_number", "laser", "ring", "line", "channel")
"""Column -> its field names in various drivers, the most specific first. Ouster's intensity is the signal, and its
reflectivity is corrected for the distance. Other fields are skipped."""
_LIKE_INTENSITY = re.compile("intens|refl|remiss|signal|amplitude")
_NOT_A_NUMBER = re.compile(rb"(?i)-?(?:nan\(\w*\)|1\.#\w*)")  # as Microsoft's C library writes it
_IDENTITY = "0001000"
_KINDS, _SIZES = {"F": "f", "I": "i", "U": "u"}, {size: size for size in "1248"}
_SPACE, _PART_BYTES = re.compile(rb"\s"), 2**20
_MAX_EXPANSION = 88  # three bytes of LZF unpack to 264 at most


def parse_pcd(
    content: bytes, where: str = "points", *, max_points: int, max_bytes: int, viewpoint: bool = False
) -> dict[str, np.ndarray]:
    """Parse the content of a PCD file into named columns; a ValueError says what is damaged.

    Args:
        where: name of the file in notes.
        max_points: limit of the number of points.
        max_bytes: limit of all points' unpacked size.
        viewpoint: transform x, y, z by the pose in the header; otherwise a note says that it was not used.

    Returns:
        x, y, z, and intensity, time_lag and laser if the file has them; one value per point, in the file's own
        units and types.

    >>> header = "FIELDS x y z ring\\nSIZE 4 4 4 1\\nTYPE F F F U\\nPOINTS 1\\nDATA ascii\\n"
    >>> table = parse_pcd(header.encode() + b"5 0 -1.5 31\\n", max_points=10, max_bytes=1000)
    >>> {name: column.tolist() for name, column in table.items()}
    {'x': [5.0], 'y': [0.0], 'z': [-1.5], 'laser': [31.0]}
    """
    header, body = _read_header(content)
    with refusing("damaged header", KeyError, TypeError, ValueError):
        fields, number = _read_fields(header), _num_points(header)
        places = find_columns([field.name for field in fields], where)
        single = all(fields[place].count == 1 for place in places.values())
        if not single or any(field.count < 1 for field in fields) or number < 0:
            found = f"{' '.join(header.get('COUNT', []))[:200]} and {number}"
            raise ValueError(f"COUNT and POINTS: got {found}, expected one value per column and point")
        read = _FORMS[" ".join(header["DATA"]).lower()]
        pose = _read_viewpoint(header, where, needed=viewpoint)
    if number > max_points or number * _size(fields) > max_bytes:
        size = f"{number} points of {_size(fields)} bytes"
        raise ValueError(f"POINTS: got {size}, expected at most {max_points} and {max_bytes} bytes in all")
    if number == 0:
        return dict.fromkeys(places, np.zeros(0))
    table = dict(zip(places, read(body, fields, number, list(places.values())), strict=True))
    if viewpoint and pose is not None:
        xyz = pose[:3, :3] @ np.array([table[axis] for axis in "xyz"], np.float64) + pose[:3, 3:]
        table |= zip("xyz", xyz, strict=True)
    return table


def find_columns(names: Sequence[str], where: str = "points") -> dict[str, int]:
    """Column -> index of the first field with its most specific name; columns without a field are left out.

    A note says if there is no intensity, but a field whose name looks like one.

    >>> find_columns(["x", "y", "z", "t", "line", "ring"])
    {'x': 0, 'y': 1, 'z': 2, 'laser': 5}
    """
    names = [name.lower() for name in names]
    found = {column: next((a for a in aliases if a in names), None) for column, aliases in _COLUMNS.items()}
    if found["intensity"] is None and (like := [name for name in names if _LIKE_INTENSITY.search(name)]):
        expected = f"rename one to intensity, or intensities are 0: {', '.join(_COLUMNS['intensity'])} are read"
        tell(
            f"note: {where}: field {', '.join(map(repr, like[:3]))} is not read: {expected}",
            once="field like an intensity",
        )
    return {column: names.index(alias) for column, alias in found.items() if alias is not None}


def _read_header(content: bytes) -> tuple[dict[str, list[str]], memoryview]:
    """Entry -> its words, and the bytes after the DATA line."""
    header, position = dict[str, list[str]](), 0
    while position < len(content) and len(header) <= 32:  # longer headers do not exist: not a PCD file
        end = content.find(b"\n", position)
        line = content[position : len(content) if end < 0 else end]
        position += len(line) + 1
        words = line.decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                return header, memoryview(content)[position:]
    raise ValueError("no DATA line in its header")


@dataclasses.dataclass(frozen=True)
class _Field:
    """A field of a point. Sizes are Python integers, which no header can overflow."""

    name: str
    dtype: np.dtype
    count: int

    @property
    def size(self) -> int:
        return self.dtype.itemsize * self.count


def _size(fields: list[_Field]) -> int:
    return sum(field.size for field in fields)


def _read_fields(header: dict[str, list[str]]) -> list[_Field]:
    names = [name.lower() for name in header.get("COLUMNS") or header["FIELDS"]]  # COLUMNS before version 0.5
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"FIELDS: got {' '.join(names)}, expected x, y and z, each once")
    each = zip(("SIZE", "TYPE", "COUNT"), "4F1", strict=True)  # defaults of old files, as in PCL
    sizes, kinds, counts = (header.get(entry, [default] * len(names)) for entry, default in each)
    return [
        _Field(name, np.dtype(f"<{_KINDS[kind.upper()]}{_SIZES[size]}"), int(count))
        for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True)
    ]


def _num_points(header: dict[str, list[str]]) -> int:
    if "POINTS" in header:
        return int(" ".join(header["POINTS"]))
    return int(" ".join(header["WIDTH"])) * int(" ".join(header.get("HEIGHT", "1")))


def _read_viewpoint(header: dict[str, list[str]], where: str, *, needed: bool) -> np.ndarray | None:
    """The VIEWPOINT as a pose f64[4, 4]; None for the identity or, with a note, if it is not ``needed``."""
    text = " ".join(header.get("VIEWPOINT", _IDENTITY))[:200]
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.zeros(7)
    unit = len(values) == 7 and np.isfinite(values).all() and abs(math.hypot(*values[3:]) - 1) < 1e-3
    pose = pose_matrix(values[3:], values[:3]) if unit else None
    if pose is not None and (pose == np.eye(4)).all():
        return None
    if not needed:
        tell(f"note: {where}: its VIEWPOINT {text!r} is not applied; --viewpoint applies it", once="VIEWPOINT")
        return None
    if pose is None:
        raise ValueError(f"VIEWPOINT: got {text!r}, expected x y z and a unit quaternion w x y z")
    return pose


def _from_ascii(body: memoryview, fields: list[_Field], number: int, places: list[int]) -> list[np.ndarray]:
    width, parts, num_values, first = sum(field.count for field in fields), list[np.ndarray](), 0, 0
    while first < len(body) and num_values <= number * width:
        # In parts, since words take many times the memory of their bytes.
        cut = _SPACE.search(body, first + _PART_BYTES)
        last = cut.start() if cut else len(body)
        part = bytes(body[first:last])
        part = _NOT_A_NUMBER.sub(b"nan", part) if b"(" in part or b"#" in part else part
        parts.append(np.array(part.split(), np.float64))
        num_values, first = num_values + len(parts[-1]), last
    if num_values != number * width:
        raise ValueError(f"DATA: got {num_values} values, expected {number} points of {width}")
    values = np.concatenate(parts).reshape(number, width)
    return [values[:, sum(field.count for field in fields[:i])] for i in places]


def _from_binary(body: memoryview, fields: list[_Field], number: int, places: list[int]) -> list[np.ndarray]:
    record = _size(fields)
    if len(body) < number * record:
        expected = f"{number * record} ({number} points of {record})"
        raise ValueError(f"DATA: truncated: got {len(body)} bytes, expected {expected}")
    return [np.ndarray((number,), fields[i].dtype, body, _size(fields[:i]), (record,)) for i in places]


def _from_compressed(body: memoryview, fields: list[_Field], number: int, places: list[int]) -> list[np.ndarray]:
    """Compressed size, plain size, and the points field by field, compressed by LZF."""
    expected = number * _size(fields)
    packed, plain = (int(v) for v in np.frombuffer(bytes(body[:8]).ljust(8, b"\0"), "<u4"))
    if len(body) < 8 + packed or plain != expected or plain > _MAX_EXPANSION * packed:
        found = f"{packed} compressed bytes of {plain}, {max(len(body) - 8, 0)} of them in the file"
        raise ValueError(f"DATA: got {found}, expected {number} points of {_size(fields)} bytes")
    content = _unpack_lzf(body[8 : 8 + packed], plain)
    return [np.frombuffer(content, fields[i].dtype, number, number * _size(fields[:i])) for i in places]


_FORMS = {"ascii": _from_ascii, "binary": _from_binary, "binary_compressed": _from_compressed}


def _unpack_lzf(packed: memoryview, size: int) -> bytearray:
    """LZF: runs of literal bytes, and copies of earlier output."""
    out, position = bytearray(), 0
    with contextlib.suppress(IndexError):  # ends within a copy
        while position < len(packed) and len(out) <= size:
            control = packed[position]
            position += 1
            if control < 32:
                out += packed[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[position]
                position += 1
            length += 2
            distance = ((control & 31) << 8) + packed[position] + 1
            position += 1
            if distance > len(out):  # from before the beginning
                break
            start = len(out) - distance
            # A copy longer than its distance repeats its own output.
            out += (out[start : start + length] * (length // distance + 1))[:length]
    if len(out) != size:
        raise ValueError(f"DATA: the compressed bytes are damaged: they do not unpack to {size} bytes")
    return out
