"""Safe parsing of ``.npy`` and ``.npz`` files: sizes are Python integers and checked before any allocation."""

import io
import math
import zipfile
from collections.abc import Sequence

import numpy as np

from fcos_lidar_jax.files import refusing

_HEADER_BYTES = 2**15  # more than NumPy reads of a header
MAX_BYTES = 2**31  # default limit of an unpacked array


def parse_npy(content: bytes, *, max_rows: int | None = None) -> np.ndarray:
    """The array of an ``.npy`` file, as a read-only view of the bytes; ``max_rows`` limits the first axis.

    Refuses pickled objects, and damaged files, also by their size.
    """
    shape, fortran, dtype, offset = _read_header(content, max_rows)
    size, actual = math.prod(shape) * dtype.itemsize, len(content) - offset
    if size != actual or size == 0 < math.prod(shape) or not all(0 <= n < 2**63 for n in shape):
        raise ValueError(f"got {actual} bytes of values, expected {size} for {shape} of {dtype}")
    if size == 0:
        return np.zeros(shape, dtype)
    return np.frombuffer(content, dtype, offset=offset).reshape(shape, order="F" if fortran else "C")


def _read_header(content: bytes, max_rows: int | None) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, Fortran order, type and offset of the values, from the first bytes of a file."""
    stream = io.BytesIO(content)
    with refusing(""):  # damaged headers raise arbitrary exceptions, even the tokenizer's
        first = np.lib.format.read_magic(stream) == (1, 0)  # later versions differ only in names of fields
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read_header(stream)
    if dtype.hasobject:
        raise ValueError("got pickled objects, expected an array without pickled objects")
    if max_rows is not None and shape and shape[0] > max_rows:
        raise ValueError(f"got {shape[0]} points, expected at most {max_rows}")
    return shape, fortran, dtype, stream.tell()


def parse_npz(
    content: bytes, names: Sequence[str], *, max_rows: int | None = None, max_bytes: int = MAX_BYTES
) -> dict[str, np.ndarray]:
    """Some arrays of an ``.npz`` file, each as in :func:`parse_npy` and with at most ``max_bytes`` unpacked.

    If a single name is given and the file has a single array, the array may have another name.
    """
    # Damaged archives raise arbitrary exceptions.
    with refusing(""), zipfile.ZipFile(io.BytesIO(content)) as archive:
        members, arrays = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}, {}
        if len(names) == len(members) == 1:
            members = dict(zip(names, members.values(), strict=True))
        for name in names:
            if name not in members:
                raise ValueError(f"got arrays {', '.join(members) or 'none'}, expected {name}")
            arrays[name] = parse_npy(_unpack(archive, members[name], max_rows, max_bytes), max_rows=max_rows)
        return arrays


def _unpack(archive: zipfile.ZipFile, member: zipfile.ZipInfo, max_rows: int | None, max_bytes: int) -> bytes:
    if member.file_size > max_bytes or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        found = f"{member.file_size} bytes, compressed by method {member.compress_type}"
        raise ValueError(f"got {found}, expected at most {max_bytes}, stored or deflated")
    with archive.open(member) as stream:
        head = stream.read(_HEADER_BYTES)
        _read_header(head, max_rows)  # before the rest is unpacked
        # Limited, since an archive may unpack to more than it says.
        return head + stream.read(max(member.file_size + 1 - len(head), 0))
