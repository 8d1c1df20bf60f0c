"""Lossless packing of batches for transfer to the device.

A packed sample contains only its valid rows, in order, and their count instead of a mask. Intensities and laser
numbers are bytes if all are whole numbers from 0 to 255. Time lags are indices into a table, because all points of
a sweep share one time lag. No value is rounded: a batch that does not fit raises :class:`MisfitError`.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.namespaces import own_names
from fcos_lidar_jax.types import Batch, PackedBatch

__dir__ = own_names(__name__)

_MAX_LAGS = 2**16  # Number of two-byte indices.


@dataclasses.dataclass(frozen=True)
class Packing:
    """Column types of packed batches: the same for all batches of a run, so that one compiled program takes them.

    >>> Packing(num_lags=1).row_bytes, Packing(num_lags=530).row_bytes, Packing(num_lags=0).row_bytes
    (14, 15, 17)
    """

    num_lags: int  # Size of the table of time lags, at most 65,536; 0 stores the lags themselves.
    byte_intensity: bool = True
    byte_laser: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.num_lags <= _MAX_LAGS:
            raise ValueError(f"num_lags: got {self.num_lags}, expected 0 to {_MAX_LAGS}")

    @property
    def lag_type(self) -> np.dtype:
        """Type of the column of time lags."""
        return np.dtype(np.float32 if not self.num_lags else np.uint8 if self.num_lags <= 256 else np.uint16)

    @property
    def row_bytes(self) -> int:
        """Bytes per point without a laser number; an unpacked point has 21."""
        return 12 + (1 if self.byte_intensity else 4) + self.lag_type.itemsize


class MisfitError(ValueError):
    """A batch does not fit the packing of its run.

    >>> error = MisfitError(3, "intensity: got 0.5, expected whole numbers from 0 to 255")
    >>> error.row, str(error)[:20]
    (3, 'intensity: got 0.5, ')
    """

    def __init__(self, row: int, message: str) -> None:
        super().__init__(message)
        self.row = row  # Row of the first sample that does not fit.


def choose_packing(clouds: Iterable[np.ndarray], *, num_sweeps: int, num_pasted: int) -> Packing:
    """Choose the most compact packing that fits the given clouds.

    Args:
        clouds: f32[n, 5 or 6] each, the valid rows of sample frames.
        num_sweeps: maximum number of sweeps per cloud and per pasted object. A cloud with more time lags has one
            time lag per point, so the packing then stores the lags themselves.
        num_pasted: maximum number of objects pasted into a frame, each with its own time lags.

    >>> cloud = np.array([[9, 0, 0, 17, 0], [8, 0, 0, 31, 0.05]], np.float32)
    >>> choose_packing([cloud], num_sweeps=10, num_pasted=60)
    Packing(num_lags=610, byte_intensity=True, byte_laser=True)
    >>> choose_packing([cloud + np.float32(0.5)], num_sweeps=1, num_pasted=0)
    Packing(num_lags=0, byte_intensity=False, byte_laser=True)
    """
    num_lags, is_byte = num_sweeps * (1 + num_pasted), {3: True, 5: True}
    num_lags = num_lags if num_lags <= _MAX_LAGS else 0
    for cloud in clouds:
        for column in is_byte.keys() & set(range(cloud.shape[1])):
            is_byte[column] &= _pack_number(cloud[:, column], np.zeros(len(cloud), np.uint8), "") is None
        num_lags = num_lags if len(np.unique(cloud[:, 4])) <= num_sweeps else 0
    return Packing(num_lags, is_byte[3], is_byte[5])


def empty_packed(size: int, packing: Packing, *, max_points: int, max_boxes: int, columns: int) -> PackedBatch:
    """All-zero packed batch of NumPy arrays, without valid rows.

    >>> empty = empty_packed(2, Packing(num_lags=9), max_points=8, max_boxes=4, columns=5)
    >>> empty.xyz.shape, empty.lags.shape, empty.laser
    ((2, 8, 3), (2, 9), None)
    """
    laser_type = np.uint8 if packing.byte_laser else np.float32
    arrays: Any = (
        np.zeros((size, max_points, 3), np.float32),
        np.zeros((size, max_points), np.uint8 if packing.byte_intensity else np.float32),
        np.zeros((size, max_points), packing.lag_type),
        np.zeros((size, packing.num_lags), np.float32),
        np.zeros((size, max_points), laser_type) if columns > 5 else None,
        np.zeros(size, np.int32),
        np.zeros((size, max_boxes, 9), np.float32),
        np.zeros((size, max_boxes), np.int32),
        np.zeros((size, max_boxes), bool),
    )
    return PackedBatch(*arrays)


def pack_row(packed: PackedBatch, row: int, sample: Batch) -> None:
    """Write a NumPy batch of one sample into a row of :func:`empty_packed`.

    Raises:
        MisfitError: with the row, the found and the expected values.

    >>> packed = empty_packed(2, Packing(num_lags=2), max_points=2, max_boxes=1, columns=5)
    >>> cloud = np.array([[[0, 0, 0, 0, 0], [8, 0, 0, 31, 0.5]]], np.float32), np.array([[False, True]])
    >>> boxes = np.zeros((1, 1, 9), np.float32), np.zeros((1, 1), np.int32), np.zeros((1, 1), bool)
    >>> pack_row(packed, 1, Batch(*cloud, *boxes))
    >>> packed.count.tolist(), packed.intensity.tolist()
    ([0, 1], [[0, 0], [31, 0]])
    """
    target: Any = jax.tree.map(lambda array: array[row], packed)
    # np.compress is much faster than indexing with a mask.
    cloud = np.compress(np.asarray(sample.valid[0]), np.asarray(sample.points[0]), axis=0)
    count = len(cloud)
    packed.count[row] = count  # type: ignore[index]
    # Copying one 12-byte item per row is faster than copying three numbers.
    target.xyz[:count].view("V12")[:] = cloud[:, :3].view("V12")
    misfit = _pack_number(cloud[:, 3], target.intensity[:count], "intensity")
    misfit = misfit or _pack_lags(cloud[:, 4], target.lag[:count], target.lags)
    if target.laser is not None:
        misfit = misfit or _pack_number(cloud[:, 5], target.laser[:count], "laser number")
    if misfit:
        raise MisfitError(row, misfit)
    target.boxes[:], target.labels[:], target.box_valid[:] = sample.boxes[0], sample.labels[0], sample.box_valid[0]


def pack(batch: Batch, packing: Packing) -> PackedBatch:
    """Pack a batch of NumPy arrays.

    Returns:
        NumPy arrays whose shapes and types depend only on the shape of the batch and the packing.

    Raises:
        MisfitError: with the row of the first sample that does not fit, the found and the expected values.

    >>> cloud = np.array([[[9, 0, 0, 17, 0], [0, 0, 0, 0, 0], [8, 0, 0, 31, 0.5]]], np.float32)
    >>> boxes = np.zeros((1, 2, 9), np.float32), np.zeros((1, 2), np.int32), np.zeros((1, 2), bool)
    >>> packed = pack(Batch(cloud, np.array([[True, False, True]]), *boxes), Packing(num_lags=2))
    >>> packed.count.tolist(), packed.xyz[0, :, 0].tolist(), packed.lag.tolist(), packed.lags.tolist()
    ([2], [9.0, 8.0, 0.0], [[0, 1, 0]], [[0.0, 0.5]])
    """
    size, rows, columns = batch.points.shape
    packed = empty_packed(size, packing, max_points=rows, max_boxes=batch.boxes.shape[1], columns=columns)
    for row in range(size):
        pack_row(packed, row, jax.tree.map(lambda leaf: leaf[row : row + 1], batch))  # noqa: B023
    return packed


def unpack(batch: Batch | PackedBatch) -> Batch:
    """Unpack a batch: valid rows first, in order, then zeros. An unpacked batch is returned unchanged.

    >>> cloud = np.array([[[9, 0, 0, 17, 0], [0, 0, 0, 0, 0], [8, 0, 0, 31, 0.5]]], np.float32)
    >>> boxes = np.zeros((1, 2, 9), np.float32), np.zeros((1, 2), np.int32), np.zeros((1, 2), bool)
    >>> batch = unpack(pack(Batch(cloud, np.array([[True, False, True]]), *boxes), Packing(num_lags=2)))
    >>> batch.points[0].tolist()
    [[9.0, 0.0, 0.0, 17.0, 0.0], [8.0, 0.0, 0.0, 31.0, 0.5], [0.0, 0.0, 0.0, 0.0, 0.0]]
    >>> batch.valid.tolist()
    [[True, True, False]]
    """
    if isinstance(batch, Batch):
        return batch
    valid = jnp.arange(batch.xyz.shape[1], dtype=jnp.int32) < jnp.asarray(batch.count)[:, None]
    lag = jnp.asarray(batch.lag)
    if batch.lags.shape[1]:
        # The indices of padding rows point to the first lag of the table, which need not be zero.
        table = jnp.take_along_axis(jnp.asarray(batch.lags), lag.astype(jnp.int32), axis=1, mode="clip")
        lag = jnp.where(valid, table, 0)
    columns: Sequence = (batch.intensity, lag) if batch.laser is None else (batch.intensity, lag, batch.laser)
    numbers = jnp.stack([jnp.asarray(column).astype(jnp.float32) for column in columns], axis=-1)
    points = jnp.concatenate([jnp.asarray(batch.xyz), numbers], axis=-1)
    return Batch(points, valid, batch.boxes, batch.labels, batch.box_valid)


def _pack_number(values: np.ndarray, packed: np.ndarray, name: str) -> str | None:
    """Write a column and return a message about the first value that does not fit."""
    with np.errstate(invalid="ignore"):  # NaN and numbers outside a byte, detected below
        packed[:] = values
    # Compare bits, because -0.0 equals 0 but must be preserved.
    same = packed.astype(np.float32).view(np.uint32) == np.ascontiguousarray(values).view(np.uint32)
    return None if same.all() else f"{name}: got {values[np.argmin(same)]}, expected whole numbers from 0 to 255"


def _pack_lags(values: np.ndarray, packed: np.ndarray, table: np.ndarray) -> str | None:
    """Write indices and the table, or the values without a table; return a message if the table is too small."""
    if not len(table):
        packed[:] = values
        return None
    bits = np.ascontiguousarray(values).view(np.uint32)  # distinguishes -0.0 from 0
    # The points of a sweep are adjacent, so there are far fewer runs of equal lags than points.
    starts = np.flatnonzero(np.concatenate([np.ones(len(bits[:1]), bool), bits[1:] != bits[:-1]]))
    lags, index = np.unique(bits[starts], return_inverse=True)
    if len(lags) > len(table):
        return f"time lag: got {len(lags)} different values in a sample, expected at most {len(table)}"
    table[: len(lags)] = lags.view(np.float32)
    packed[:] = np.repeat(index.astype(packed.dtype), np.diff(starts, append=len(bits)))
    return None
