"""PCD files: ascii, binary and binary_compressed."""

import contextlib
import dataclasses
import re
from collections.abc import Sequence

import numpy as np

_COLUMNS: dict[str, tuple[str, ...]] = {name: (name,) for name in ("x", "y", "z", "time_lag")}
_COLUMNS["intensity"] = ("intensity", "reflectivity")
_COLUMNS["laser"] = ("laser_number", "laser", "ring", "line", "channel")
"""Column -> its field names in various drivers, the most specific first. Other fields are skipped."""
_KINDS, _SIZES = {"F": "f", "I": "i", "U": "u"}, {size: size for size in "1248"}
_SPACE, _PART_BYTES = re.compile(rb"\s"), 2**20
_MAX_EXPANSION = 88  # three bytes of LZF unpack to 264 at most


def parse_pcd(content: bytes, *, max_points: int, max_bytes: int) -> dict[str, np.ndarray]:
    """Parse the content of a PCD file into named columns; a ValueError says what is damaged.

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
    try:
        fields, number = _read_fields(header), _num_points(header)
        places = find_columns([field.name for field in fields])
        if any(fields[place].count != 1 for place in places.values()) or number < 0:
            raise ValueError("expected one value per column and point")
        read = _FORMS[" ".join(header["DATA"]).lower()]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"damaged header: {error}") from None
    if number > max_points or number * _size(fields) > max_bytes:
        size = f"{number} points of {_size(fields)} bytes"
        raise ValueError(f"POINTS: got {size}, expected at most {max_points} and {max_bytes} bytes in all")
    if number == 0:
        return dict.fromkeys(places, np.zeros(0))
    columns = read(body, fields, number, list(places.values()))
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
    names = [name.lower() for name in header["FIELDS"]]
    if any(names.count(axis) != 1 for axis in "xyz"):
        raise ValueError(f"FIELDS: got {' '.join(names)}, expected x, y and z, each once")
    counts = header.get("COUNT", ["1"] * len(names))
    fields = [
        _Field(name, np.dtype(f"<{_KINDS[kind.upper()]}{_SIZES[size]}"), int(count))
        for name, size, kind, count in zip(names, header["SIZE"], header["TYPE"], counts, strict=True)
    ]
    if any(field.count < 1 for field in fields):
        raise ValueError(f"COUNT: got {' '.join(counts)}, expected at least 1 each")
    return fields


def _num_points(header: dict[str, list[str]]) -> int:
    if "POINTS" in header:
        return int(" ".join(header["POINTS"]))
    return int(" ".join(header["WIDTH"])) * int(" ".join(header["HEIGHT"]))


def _from_ascii(body: memoryview, fields: list[_Field], number: int, places: list[int]) -> list[np.ndarray]:
    width, parts, num_values, first = sum(field.count for field in fields), list[np.ndarray](), 0, 0
    while first < len(body) and num_values <= number * width:
        # In parts, since words take many times the memory of their bytes.
        cut = _SPACE.search(body, first + _PART_BYTES)
        last = cut.start() if cut else len(body)
        parts.append(np.array(bytes(body[first:last]).split(), np.float64))
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
