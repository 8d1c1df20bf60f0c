"""PCD files: ascii, binary and binary_compressed."""

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.fields import check

_COLUMNS: dict[str, tuple[str, ...]] = {name: (name,) for name in ("x", "y", "z", "time_lag")}
_COLUMNS["intensity"] = ("intensity", "reflectivity")
_COLUMNS["laser"] = ("laser_number", "laser", "ring", "line", "channel")
"""Column -> its field names in various drivers, the most specific first. Other fields are skipped."""
_KINDS = {"F": ("f", "248"), "I": ("i", "1248"), "U": ("u", "1248")}
"""TYPE -> NumPy's type letter and the allowed sizes."""
_SPACE, _PART_BYTES = re.compile(rb"\s"), 2**20
_MAX_COUNT = 1_000_000  # values per field of a point; more means a damaged header
_MAX_EXPANSION = 88  # three bytes of LZF unpack to 264 at most


def parse_pcd(content: bytes, *, max_points: int, max_bytes: int) -> dict[str, np.ndarray]:
    """Parse the content of a PCD file into named columns; errors name the header's field.

    Args:
        max_points: limit of the number of points.
        max_bytes: limit of all points' unpacked size.

    Returns:
        x, y, z, and intensity, time_lag and laser if the file has them; one value per point, in the file's own
        units and types.

    >>> header = "FIELDS x y z ring\\nSIZE 4 4 4 1\\nTYPE F F F U\\nPOINTS 1\\nDATA ascii\\n"
    >>> table = parse_pcd(header.encode() + b"5 0 -1.5 31\\n", max_points=10, max_bytes=1000)
    >>> {name: column.tolist() for name, column in table.items()}
    {'x': [5.0], 'y': [0.0], 'z': [-1.5], 'laser': [31.0]}
    """
    header, body = _read_header(content)
    fields = _read_fields(header)
    number = _num_points(header)
    if number > max_points or number * _size(fields) > max_bytes:
        size = f"{number} points of {_size(fields)} bytes"
        raise ValueError(f"POINTS: got {size}, expected at most {max_points} and {max_bytes} bytes in all")
    form = " ".join(header["DATA"]).lower()
    check(form in _FORMS, "DATA", form, ", ".join(_FORMS))
    places = find_columns([field.name for field in fields])
    for field in (fields[place] for place in places.values()):
        if field.count != 1:
            raise ValueError(f"COUNT: got {field.count} for field {field.name}, expected 1")
    if number == 0:
        return dict.fromkeys(places, np.zeros(0))
    columns = _FORMS[form](body, fields, number, list(places.values()))
    return dict(zip(places, columns, strict=True))


def find_columns(names: Sequence[str]) -> dict[str, int]:
    """Column -> index of the first field with its most specific name; columns without a field are left out.

    >>> find_columns(["x", "y", "z", "t", "line", "ring"])
    {'x': 0, 'y': 1, 'z': 2, 'laser': 5}
    """
    found = {column: next((a for a in aliases if a in names), None) for column, aliases in _COLUMNS.items()}
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
    raise ValueError("not a PCD file: no DATA line in its header")


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
    fields = [name.lower() for name in header.get("FIELDS", [])]
    for axis in "xyz":
        if fields.count(axis) != 1:
            raise ValueError(f"FIELDS: got {fields.count(axis)} named {axis} in {fields}, expected one")
    columns = {"COUNT": ["1"] * len(fields)} | {k: header[k] for k in ("SIZE", "TYPE", "COUNT") if k in header}
    for name in ("SIZE", "TYPE", "COUNT"):
        number = len(columns.get(name, []))
        if number != len(fields):
            raise ValueError(f"{name}: got {number} entries, expected {len(fields)} as in FIELDS")
    parsed = []
    for field, size, kind, count in zip(fields, columns["SIZE"], columns["TYPE"], columns["COUNT"], strict=True):
        letter, sizes = _KINDS.get(kind.upper(), ("", ""))
        if not letter or size not in tuple(sizes):
            expected = "F 2, 4, 8 or I, U 1, 2, 4, 8"
            raise ValueError(f"TYPE and SIZE: got {kind} {size} for field {field}, expected {expected}")
        if not count.isdecimal() or not 1 <= int(count) <= _MAX_COUNT:
            raise ValueError(f"COUNT: got {count} for field {field}, expected an integer of at least 1")
        parsed.append(_Field(field, np.dtype(f"<{letter}{size}"), int(count)))
    return parsed


def _num_points(header: dict[str, list[str]]) -> int:
    numbers = {}
    for name in ("POINTS", "WIDTH", "HEIGHT"):
        if (words := header.get(name)) is not None:
            check(len(words) == 1 and words[0].isdecimal(), name, " ".join(words), "an integer of at least 0")
            numbers[name] = int(words[0])
    product = numbers["WIDTH"] * numbers["HEIGHT"] if {"WIDTH", "HEIGHT"} <= set(numbers) else None
    points = numbers.get("POINTS", product)
    if points is None:
        raise ValueError("POINTS: missing in the header, as are WIDTH and HEIGHT")
    check(product in (None, points), "POINTS", points, f"WIDTH x HEIGHT, which is {product}")
    return points


def _from_ascii(body: memoryview, fields: list[_Field], number: int, places: list[int]) -> list[np.ndarray]:
    width, parts, num_values, first = sum(field.count for field in fields), list[np.ndarray](), 0, 0
    while first < len(body):  # in parts, since words take many times the memory of their bytes
        cut = _SPACE.search(body, first + _PART_BYTES)
        last = cut.start() if cut else len(body)
        words = bytes(body[first:last]).split()
        num_values, first = num_values + len(words), last
        if num_values > number * width:
            found = f"got {num_values} values and more"
            raise ValueError(f"DATA: too long: {found}, expected {number} points of {width}")
        try:
            parts.append(np.array(words, np.float64))
        except ValueError as error:
            raise ValueError(f"DATA: {error}, expected a number") from None
    if num_values < number * width:
        raise ValueError(f"DATA: truncated: got {num_values} values, expected {number} points of {width}")
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
    if len(body) < 8 + packed:
        raise ValueError(f"DATA: truncated: got {max(len(body) - 8, 0)} compressed bytes, expected {packed}")
    if plain != expected:
        raise ValueError(f"DATA: got {plain} uncompressed bytes, expected {expected} for {number} points")
    if plain > _MAX_EXPANSION * packed:
        raise ValueError(f"DATA: got {packed} compressed bytes, expected more: they cannot unpack to {plain}")
    content = _unpack_lzf(body[8 : 8 + packed], plain)
    return [np.frombuffer(content, fields[i].dtype, number, number * _size(fields[:i])) for i in places]


_FORMS = {"ascii": _from_ascii, "binary": _from_binary, "binary_compressed": _from_compressed}


def _unpack_lzf(packed: memoryview, size: int) -> bytearray:
    """LZF: runs of literal bytes, and copies of earlier output."""
    out, position = bytearray(), 0
    try:
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
            if distance > len(out):
                raise ValueError("DATA: the compressed bytes are damaged: a copy from before the beginning")
            start = len(out) - distance
            # A copy longer than its distance repeats its own output.
            out += (out[start : start + length] * (length // distance + 1))[:length]
    except IndexError:
        raise ValueError("DATA: the compressed bytes are damaged: they end within a copy") from None
    if len(out) != size:
        raise ValueError(f"DATA: the compressed bytes are damaged: they do not unpack to {size} bytes")
    return out
