"""PCD files by their header: ascii, binary and binary_compressed."""

from pathlib import Path

import numpy as np

_NAMES = {
    "x": "x",
    "y": "y",
    "z": "z",
    "intensity": "intensity",
    "reflectivity": "intensity",
    "time_lag": "time_lag",
    "ring": "laser",
    "laser": "laser",
    "laser_number": "laser",
}
"""Fields that are read, and what they are called here; others are skipped."""
_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path, error: type[ValueError]) -> dict[str, np.ndarray]:
    """Named columns of a PCD file: x, y, z, and of intensity, time_lag and laser those that are there.

    Args:
        path: the file.
        error: raised with one line that names the file, the finding and the expectation.
    """
    content = path.read_bytes()
    header, body = _read_header(path, content, error)
    dtype = _record_type(path, header, error)
    try:
        number = int(header["POINTS"][0]) if "POINTS" in header else _product(header)
    except (KeyError, ValueError, IndexError):
        raise error(f"{path}: POINTS: missing or not a number in the header") from None
    form = header.get("DATA", [""])[0].lower()
    if form == "ascii":
        records = _from_ascii(path, body, dtype, number, error)
    elif form == "binary":
        if len(body) < number * dtype.itemsize:
            raise error(f"{path}: truncated: got {len(body)} bytes of points, expected {number * dtype.itemsize}")
        records = np.frombuffer(body, dtype, number)
    elif form == "binary_compressed":
        records = _from_compressed(path, body, dtype, number, error)
    else:
        raise error(f"{path}: DATA: got {form!r}, expected ascii, binary or binary_compressed")
    table = {}
    for field in dtype.names or ():
        name = _NAMES.get(field.lower())
        if name is not None and records[field].ndim == 1:
            table[name] = records[field]
    for axis in "xyz":
        if axis not in table:
            raise error(f"{path}: FIELDS: no {axis} among {', '.join(dtype.names or ())}")
    return table


def _product(header: dict[str, list[str]]) -> int:
    return int(header["WIDTH"][0]) * int(header["HEIGHT"][0])


def _read_header(path: Path, content: bytes, error: type[ValueError]) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    position = 0
    while position < len(content):
        end = content.find(b"\n", position)
        if end < 0:
            break
        words = content[position:end].decode("ascii", "replace").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        header[words[0].upper()] = words[1:]
        if words[0].upper() == "DATA":
            return header, content[position:]
        if len(header) > 32:
            break
    raise error(f"{path}: not a PCD file: no DATA line in its header")


def _record_type(path: Path, header: dict[str, list[str]], error: type[ValueError]) -> np.dtype:
    fields = header.get("FIELDS", [])
    sizes, kinds = header.get("SIZE", []), header.get("TYPE", [])
    counts = header.get("COUNT", ["1"] * len(fields))
    if not fields or not len(fields) == len(sizes) == len(kinds) == len(counts):
        raise error(f"{path}: header: FIELDS, SIZE, TYPE and COUNT must list as many entries each")
    columns, used = [], set()
    for i, (field, size, kind, count) in enumerate(zip(fields, sizes, kinds, counts, strict=True)):
        if kind not in _KINDS or size not in ("1", "2", "4", "8") or not count.isdigit() or kind + size == "F1":
            raise error(f"{path}: header: field {field}: got TYPE {kind} SIZE {size} COUNT {count}")
        name = field if field not in used and field != "_" else f"{field}{i}"
        used.add(name)
        base = np.dtype(f"<{_KINDS[kind]}{size}")
        columns.append((name, base) if count == "1" else (name, base, (int(count),)))
    return np.dtype(columns)


def _widths(dtype: np.dtype) -> list[int]:
    assert dtype.names is not None
    return [int(np.prod(dtype[name].shape, dtype=int)) for name in dtype.names]


def _from_ascii(path: Path, body: bytes, dtype: np.dtype, number: int, error: type[ValueError]) -> np.ndarray:
    words = body.split()
    width = sum(_widths(dtype))
    if len(words) != number * width:
        raise error(f"{path}: truncated: got {len(words)} values, expected {number} points of {width}")
    try:
        values = np.array(words, np.float64).reshape(number, width)
    except ValueError:
        raise error(f"{path}: a value among the points is not a number") from None
    records = np.zeros(number, np.dtype([(n, "<f8", dtype[n].shape) for n in dtype.names or ()]))
    first = 0
    for name, size in zip(dtype.names or (), _widths(dtype), strict=True):
        records[name] = values[:, first : first + size].reshape(number, *dtype[name].shape)
        first += size
    return records


def _from_compressed(path: Path, body: bytes, dtype: np.dtype, number: int, error: type[ValueError]) -> np.ndarray:
    """Points stored field by field and packed by LZF."""
    if len(body) < 8:
        raise error(f"{path}: truncated: no room for the sizes of the compressed data")
    packed, size = (int(v) for v in np.frombuffer(body[:8], "<u4"))
    if size != number * dtype.itemsize or len(body) < 8 + packed:
        raise error(f"{path}: truncated: the compressed data do not hold {number} points")
    plain = _unpack_lzf(body[8 : 8 + packed], size)
    if plain is None:
        raise error(f"{path}: the compressed data are damaged")
    records, first = np.zeros(number, dtype), 0
    for name in dtype.names or ():
        count = number * dtype[name].itemsize
        base, shape = dtype[name].base, dtype[name].shape
        records[name] = np.frombuffer(plain[first : first + count], base).reshape(number, *shape)
        first += count
    return records


def _unpack_lzf(packed: bytes, size: int) -> bytes | None:
    """LZF: literal runs, and copies of what was already written; None where the data are damaged."""
    out, position = bytearray(), 0
    try:
        while position < len(packed):
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
            start = len(out) - ((control & 31) << 8) - packed[position] - 1
            position += 1
            if start < 0:
                return None
            for i in range(start, start + length + 2):  # the copy may overlap what it writes
                out.append(out[i])
    except IndexError:
        return None
    return bytes(out) if len(out) == size else None
