"""Points of each box, in the frame of the box."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32

from fcos_lidar_jax.forms import in_form
from fcos_lidar_jax.refinement.types import LONGEST_M, Crops

_WORD = 32  # Bits of a word.
_ROW_BITS = 24  # Bits of the row of a point; the remaining 40 of a 64-bit word are its hash.
_FAR_M = np.float32(1e9)  # Position of rows that belong to no box.


def crop_points(
    points: Float32[Array, "n c"],
    valid: Bool[Array, "n"],
    boxes: Float32[Array, "m k"],
    *,
    num_points: int,
    margin_m: float,
) -> Crops:
    """Points inside of boxes that are enlarged by a margin on every side.

    Boxes with more than ``num_points`` points get those with the smallest hashes. A hash depends on the values of
    a point only, so the choice is the same for points in another order and under ``jit`` and ``vmap``.

    Args:
        points: x, y, z, intensity, time lag, ... of one cloud; rows that are not finite belong to no box.
        valid: False for padding.
        boxes: ``x, y, z, l, w, h, yaw, ...``.
        num_points: p, maximum number of points per box (static).
        margin_m: metres added on each side of a box (static).

    >>> car = jnp.array([[10.0, 0, 0, 4, 2, 1.5, jnp.pi / 2]])
    >>> cloud = jnp.array([[10.0, 1, 0, 7, 0], [10, 9, 0, 7, 0]])
    >>> crops = crop_points(cloud, jnp.ones(2, bool), car, num_points=3, margin_m=1.0)
    >>> crops.points[0, 0, :3].round().tolist(), crops.count.tolist()
    ([1.0, -0.0, 0.0], [1])
    """
    number = points.shape[0]  # which may be symbolic in an exported program
    num_words = number // _WORD + 1
    padding = num_words * _WORD - number
    # The barrier isolates the arithmetic, so that points round identically in every program that contains it.
    points = lax.optimization_barrier(jnp.asarray(points, jnp.float32)[:, :5])
    points = jnp.concatenate([points, jnp.zeros((padding, 5), jnp.float32)])
    usable = jnp.concatenate([jnp.asarray(valid), jnp.zeros(padding, bool)]) & jnp.isfinite(points).all(axis=1)
    points = jnp.where(usable[:, None], points, 0.0)
    order = _order(points, usable)
    points = points[order]
    usable = jnp.arange(points.shape[0]) < usable.sum()
    half = jnp.minimum(boxes[:, 3:6], LONGEST_M) / 2 + margin_m
    frame = jnp.cos(boxes[:, 6]), jnp.sin(boxes[:, 6])

    position = jnp.where(usable[:, None], points[:, :3], _FAR_M).reshape(num_words, _WORD, 3)
    row, count = _first_set_bits(_inside(position, boxes, half, frame), num_points)
    taken = jnp.arange(num_points) < count[:, None]
    row = jnp.where(taken, row, 0)
    chosen = points[row]
    local = _to_frame([chosen[..., i] for i in range(3)], boxes[:, None], [f[:, None] for f in frame])
    chosen = jnp.concatenate([jnp.stack(local, axis=-1), chosen[..., 3:]], axis=-1)
    return Crops(jnp.where(taken[..., None], chosen, 0.0), jnp.where(taken, order[row], -1), count)


def _inside(position: Array, boxes: Array, half: Array, frame: tuple[Array, Array]) -> Array:
    """Words u32[m, w]: bit b of word w tells whether position [w, b] is inside of the box.

    A bit per point is faster to count than a byte. Bits are combined without a reduction, and words are the last
    axis, so that XLA tests and packs many words at once; a loop over the bytes keeps the program small.
    """
    by_bit = [position[..., i].T.reshape(_WORD // 8, 8, -1) for i in range(3)]
    sides = [half[:, i : i + 1] for i in range(3)]

    def add_byte(byte: Array, words: Array) -> Array:
        bits = jnp.zeros_like(words)
        for bit in range(8):
            local = _to_frame([axis[byte, bit] for axis in by_bit], boxes[:, None], [f[:, None] for f in frame])
            x, y, z = (jnp.abs(d) < side for d, side in zip(local, sides, strict=True))
            bits |= (x & y & z).astype(jnp.uint32) << bit
        return words | bits << (8 * byte).astype(jnp.uint32)

    return lax.fori_loop(0, _WORD // 8, add_byte, jnp.zeros((boxes.shape[0], position.shape[0]), jnp.uint32))


def _to_frame(xyz: list[Array], boxes: Array, frame: list[Array]) -> list[Array]:
    """Positions in the frame of each box."""
    dx, dy, dz = (p - boxes[..., i] for i, p in enumerate(xyz))
    cos, sin = frame
    return [cos * dx + sin * dy, cos * dy - sin * dx, dz]


def _order(points: Array, usable: Array) -> Array:
    """Order of the rows by a hash of their values, usable rows first."""
    low, high = (_hash(points, seed) for seed in (0x9E3779B9, 0x7FEB352D))
    high = jnp.where(usable, high >> 1, jnp.uint32(0xFFFFFFFF))
    forms = {"word": _by_word, "columns": _by_columns}
    return in_form(None, forms, high, low, tpu="columns", default="word")


def _hash(points: Array, seed: int) -> Array:
    """A 32-bit hash of the bits of each row; both zeros are the same."""
    bits = lax.bitcast_convert_type(points, jnp.uint32)
    bits = jnp.where(bits == jnp.uint32(1 << 31), jnp.uint32(0), bits)  # XLA would remove the addition of 0.0
    mixed = jnp.full(points.shape[0], seed, jnp.uint32)
    for column in range(bits.shape[1]):
        mixed = (mixed ^ bits[:, column]) * jnp.uint32(0x85EBCA6B)
        mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(0xC2B2AE35)
        mixed = mixed ^ (mixed >> 13)
    return mixed


def _by_word(high: Array, low: Array) -> Array:
    # One word sorts five times faster than several columns. The row takes the place of the lowest bits.
    with jax.enable_x64(True):
        word = ((high.astype(jnp.uint64) << 32) | low.astype(jnp.uint64)) >> _ROW_BITS << _ROW_BITS
        row = jnp.uint64((1 << _ROW_BITS) - 1)
        return (jnp.sort(word | lax.iota(jnp.uint64, low.shape[0])) & row).astype(jnp.int32)


def _by_columns(high: Array, low: Array) -> Array:
    return lax.sort((high, low >> _ROW_BITS << _ROW_BITS, lax.iota(jnp.int32, low.shape[0])), num_keys=3)[2]


def _first_set_bits(words: Array, number: int) -> tuple[Array, Array]:
    """Positions of the first set bits in each row of words u32[m, w], and the number of all set bits."""
    counts = lax.population_count(words).astype(jnp.int32)
    until = jnp.cumsum(counts, axis=1)
    before = until - counts
    # The last word that begins at or before a slot.
    begins = jnp.where(counts > 0, jnp.minimum(before, number), number)
    boxes, order = jnp.arange(words.shape[0])[:, None], lax.broadcasted_iota(jnp.int32, words.shape, 1)
    word = jnp.zeros((words.shape[0], number + 1), jnp.int32).at[boxes, begins].max(order)[:, :number]
    word = lax.cummax(word, axis=1)
    bits = jnp.take_along_axis(words, word, axis=1)
    rank = jnp.arange(number) - jnp.take_along_axis(before, word, axis=1)  # Within the word.
    prefixes = np.uint32((np.uint64(2) << np.arange(_WORD, dtype=np.uint64)) - 1)
    within = lax.population_count(bits[..., None] & prefixes).astype(jnp.int32)
    return word * _WORD + (within <= rank[..., None]).sum(axis=-1, dtype=jnp.int32), until[:, -1]
