"""NumPy's files from their bytes: sizes are Python's integers, compared before anything is allocated."""

import io
import math
import zipfile
from collections.abc import Sequence

import numpy as np

_HEADER_BYTES = 2**15  # more than NumPy reads of a header
MAX_BYTES = 2**31  # of an array from a packed archive, unless another limit is given


def parse_npy(content: bytes, *, max_rows: int | None = None) -> np.ndarray:
    """The array of an ``.npy`` file, read-only, as a view of the bytes.

    Args:
        content: the whole file.
        max_rows: along the first axis; None for no limit.

    Raises:
        ValueError: damaged, of pickled objects, of another size than its header says, or too long.

    >>> stream = io.BytesIO()
    >>> np.save(stream, np.arange(3))
    >>> parse_npy(stream.getvalue()).tolist()
    [0, 1, 2]
    """
    shape, fortran, dtype, offset = _read_header(content, max_rows)
    size, found = math.prod(shape) * dtype.itemsize, len(content) - offset
    if size != found or size == 0 < math.prod(shape) or not all(0 <= n < 2**63 for n in shape):
        raise ValueError(f"got {found} bytes of values, expected {size} for {shape} of {dtype}")
    if size == 0:
        return np.zeros(shape, dtype)
    return np.frombuffer(content, dtype, offset=offset).reshape(shape, order="F" if fortran else "C")


def _read_header(content: bytes, max_rows: int | None) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, order, type and first byte of the values, from at least the first of the file's bytes."""
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in read_header:
            raise ValueError(f"version: got {version}, expected 1.0 or 2.0")
        shape, fortran, dtype = read_header[version](stream)
    except Exception as error:  # damaged headers fail in a dozen ways, down to the tokenizer's
        raise ValueError(" ".join(str(error).split())) from None
    if dtype.hasobject:
        raise ValueError("got pickled objects, expected an array without pickled objects")
    if max_rows is not None and shape and shape[0] > max_rows:
        raise ValueError(f"got {shape[0]} points, expected at most {max_rows}")
    return shape, fortran, dtype, stream.tell()


def npz_names(content: bytes) -> list[str]:
    """Names of the arrays in an ``.npz`` file; ValueError where it is none."""
    return list(_members(content))


def parse_npz(
    content: bytes, names: Sequence[str], *, max_rows: int | None = None, max_bytes: int = MAX_BYTES
) -> dict[str, np.ndarray]:
    """Arrays of an ``.npz`` file.

    Args:
        content: the whole file.
        names: which arrays.
        max_rows: as in :func:`parse_npy`.
        max_bytes: of an array when it is unpacked.

    Raises:
        ValueError: damaged, an array is missing or too large, or as :func:`parse_npy`.
    """
    members, arrays = _members(content), {}
    for name in names:
        if name not in members:
            raise ValueError(f"got arrays {', '.join(members) or 'none'}, expected {name}")
        member = members[name]
        if member.file_size > max_bytes:
            raise ValueError(f"got {member.file_size} bytes unpacked, expected at most {max_bytes}")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("got another compression, expected none or deflate")
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive, archive.open(member) as stream:
                head = stream.read(_HEADER_BYTES)
                _read_header(head, max_rows)  # before the rest is unpacked
                # A limit, for it may unpack to more than it says.
                unpacked = head + stream.read(max(member.file_size + 1 - len(head), 0))
        except Exception as error:  # likewise
            raise ValueError(" ".join(str(error).split())) from None
        arrays[name] = parse_npy(unpacked, max_rows=max_rows)
    return arrays


def _members(content: bytes) -> dict[str, zipfile.ZipInfo]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    except Exception as error:  # likewise
        raise ValueError(" ".join(str(error).split())) from None
