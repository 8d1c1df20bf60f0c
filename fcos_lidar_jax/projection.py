"""Points to a range image by multi-round projection (paper, sections 3.1 and 3.2).

Every round keeps, per cell, the point with the smallest key, by a scatter-min; the losers enter the next round. On
TPUs one sort does the same. A key is exact and total: older sweep, then bits of the range, then row of the input.
So the winners do not depend on the order in which a device works, on batching, on ``jit`` or on the number of
devices. They may depend on the platform: square roots, divisions and angles of a CPU, a GPU and a TPU can differ
in the last bit, which moves a point at the edge of a cell or changes which of two equally far points wins.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.forms import in_form, search
from fcos_lidar_jax.geometry import image_columns, spherical
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import RangeImage


def close_to_sensor(
    points: Float32[Array | np.ndarray, "n c"], sensor: Sensor, close_m: float
) -> Bool[Array | np.ndarray, "n"]:
    """Points on the ego vehicle: ``|x| < close_m`` and ``|y| < close_m`` around the sensor.

    NumPy gives NumPy, so that clouds of any length can be filtered on the host without compiling.

    >>> close_to_sensor(jnp.zeros((1, 5)), Sensor("two", (0.1, 0.0), 8), 1.0).tolist()
    [True]
    """
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        x, y = points[:, 0] - sensor.origin_m[0], points[:, 1] - sensor.origin_m[1]
        return (abs(x) < close_m) & (abs(y) < close_m)


def remove_close(
    points: Float32[Array | np.ndarray, "n c"],
    valid: Bool[Array | np.ndarray, "n"],
    sensor: Sensor,
    reading: CloudReading,
) -> Bool[Array | np.ndarray, "n"]:
    """``valid`` without the points on the ego vehicle, judged in the current frame.

    Args:
        points: x, y, z, intensity, time lag; NumPy or JAX, as is the answer.
        valid, sensor: rows that count, and the sensor, which gives the origin.
        reading: of which sweeps they are dropped, and the size of the square that is emptied.

    >>> me = jnp.zeros((1, 5))
    >>> remove_close(me, jnp.ones(1, bool), Sensor("two", (0.1, 0.0), 8), CloudReading(1, "all")).tolist()
    [False]
    """
    if reading.remove_close == "none":
        return valid
    close = close_to_sensor(points, sensor, reading.close_m)
    if reading.remove_close == "sweeps":
        close = close & (points[:, 4] != 0)
    return valid & ~close


@functools.partial(jax.jit, static_argnames="sensor")
def image_cells(
    points: Float32[Array, "n c"], valid: Bool[Array, "n"], sensor: Sensor
) -> tuple[Int32[Array, "n"], tuple[Float32[Array, "n"], ...]]:
    """The image cell of every point.

    Rows are bin centres (the beams), the top row the highest beam; columns run clockwise from azimuth pi, or from
    the left end of the sensor's sector. Points that are invalid, non-finite, outside the limits, beside the sector
    or more than half a row outside the field of view get the sentinel cell ``num_rows * num_columns``.

    Returns:
        row-major cells, and (range, azimuth, inclination) as seen from the sensor, finite everywhere.

    >>> two = Sensor("two", (0.1, 0.0), 8)
    >>> image_cells(jnp.array([[-5.0, 1e-3, 0, 0, 0]]), jnp.ones(1, bool), two)[0].tolist()
    [8]
    """
    # The barriers fence the arithmetic off, so that it rounds alike whatever program it is compiled into.
    points, valid = lax.optimization_barrier((points, valid))
    usable = valid & jnp.isfinite(points).all(axis=1)
    points = jnp.where(usable[:, None], points, 0.0)
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    low, high = sensor.limit_z_m
    usable &= (jnp.abs(x) < sensor.limit_xy_m) & (jnp.abs(y) < sensor.limit_xy_m) & (z > low) & (z < high)
    range_m, azimuth, inclination = spherical(points[:, :3] - np.asarray(sensor.origin_m, np.float32))
    column, inside = image_columns(azimuth, sensor)
    usable &= inside
    row = points[:, 5].astype(jnp.int32) if sensor.row_source == "laser" else _row(inclination, sensor)
    usable &= (row >= 0) & (row < sensor.num_rows)
    cell = jnp.where(usable, row * sensor.num_columns + column, sensor.num_rows * sensor.num_columns)
    return lax.optimization_barrier((cell.astype(jnp.int32), (range_m, azimuth, inclination)))


def _row(inclination: Float32[Array, "n"], sensor: Sensor) -> Int32[Array, "n"]:
    """Nearest beam; outside the field of view -1 or ``num_rows``."""
    step = sensor.even_step_rad
    if step is not None:
        top = np.float32(sensor.inclinations_rad[0])
        return jnp.floor((top - inclination) * np.float32(1 / step) + 0.5).astype(jnp.int32)
    edges = -np.asarray(sensor.row_edges_rad, np.float32)
    row = search(jnp.asarray(edges), -inclination, side="right")
    return row.astype(jnp.int32) - 1


def priority_keys(
    range_m: Float32[Array, "n"], time_lag: Float32[Array, "n"], *, prioritize_current: bool
) -> Array:
    """Exact 32-bit keys, smaller is better: older sweep, then the bits of the range.

    The bits of a non-negative float32 order like the number itself and leave the top bit free.

    >>> keys = priority_keys(jnp.array([9.0, 1.0]), jnp.array([0.0, 0.05]), prioritize_current=True)
    >>> bool(keys[0] < keys[1])
    True
    """
    bits = lax.bitcast_convert_type(range_m, jnp.uint32)
    if not prioritize_current:
        return bits
    return bits | jnp.where(time_lag != 0, jnp.uint32(1 << 31), jnp.uint32(0))


def winners(
    cell: Int32[Array, "n"],
    keys: Array,
    *,
    num_cells: int,
    num_rounds: int,
    form: Literal["scatter", "sort"] | None = None,
) -> Int32[Array, "s r"]:
    """The point that each cell keeps in each round (paper, section 3.2).

    Args:
        cell: row-major cells, ``num_cells`` for points that take no part.
        keys: u32[n], smaller ones are better; equal ones are settled by the lower index.
        num_cells, num_rounds: s and r (static).
        form: a scatter-min per round, or one sort of all points; the same result (static). None: the sort on TPUs,
            which have no 64-bit integers, else the scatter.

    Returns:
        point index for every cell and round, -1 where nothing is left.

    >>> keys = jnp.array([7, 3, 5], jnp.uint32)
    >>> winners(jnp.array([0, 0, 0]), keys, num_cells=1, num_rounds=4).tolist()
    [[1, 2, 0, -1]]
    """
    forms = {"scatter": _by_scatter, "sort": _by_sort}
    sized = {name: functools.partial(of, num_cells=num_cells, num_rounds=num_rounds) for name, of in forms.items()}
    return in_form(form, sized, cell, keys, tpu="sort", default="scatter")


def _by_scatter(cell: Array, keys: Array, *, num_cells: int, num_rounds: int) -> Array:
    # Key and index in one word settle ties in the same scatter. 64 bits are switched on for this alone.
    with jax.enable_x64(True):
        word = (keys.astype(jnp.uint64) << 32) | lax.iota(jnp.uint64, cell.shape[0])
        empty = jnp.uint64(np.iinfo(np.uint64).max)

        def one_round(left: Array, _: None) -> tuple[Array, Array]:
            best = jnp.full(num_cells + 1, empty).at[cell].min(left, mode="promise_in_bounds")
            return jnp.where(best[cell] >= left, empty, left), best[:num_cells]

        # A loop, because unrolled rounds make XLA compute every point's cell anew in each of them.
        _, kept = lax.scan(one_round, word, length=num_rounds)
        kept = kept.T
        index = (kept & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)
        return jnp.where(kept == empty, jnp.int32(-1), index)


def _by_sort(cell: Array, keys: Array, *, num_cells: int, num_rounds: int) -> Array:
    place = lax.iota(jnp.int32, cell.shape[0])
    cell, _, index = lax.sort((cell, keys, place), num_keys=3)
    first = lax.cummax(jnp.where(jnp.diff(cell, prepend=-1) != 0, place, 0))  # Of the point's cell.
    rank = place - first
    slot = jnp.where((rank < num_rounds) & (cell < num_cells), cell * num_rounds + rank, num_cells * num_rounds)
    empty = jnp.full(num_cells * num_rounds, -1, jnp.int32)
    return empty.at[slot].set(index, mode="drop").reshape(num_cells, num_rounds)


@functools.partial(jax.jit, static_argnames=("sensor", "num_rounds", "prioritize_current"))
def project_points(
    points: Float32[Array | np.ndarray, "n c"],
    valid: Bool[Array | np.ndarray, "n"],
    sensor: Sensor,
    *,
    num_rounds: int = 5,
    prioritize_current: bool = True,
) -> RangeImage:
    """Multi-round range-view projection of one cloud (paper, sections 3.1 and 3.2).

    Applies the sensor's range limits and vertical field of view and drops non-finite rows; never drops close
    points (see :func:`remove_close`).

    Args:
        points: x, y, z (metres), intensity (0-255), time lag (seconds, exactly 0 for the current sweep), and
            the laser number as a sixth column for sensors whose rows come from it.
        valid: rows that count.
        sensor, num_rounds: the image's geometry, and its rounds (static).
        prioritize_current: points of the current sweep win every collision with older ones (static).

    Returns:
        the image, with ``point_index`` counting rows of ``points`` as given.

    Raises:
        ValueError: at trace time, when the columns do not fit the sensor.

    >>> cloud = np.array([[0, 9, 0, 50, 0], [0, 5, 0, 60, 0]], np.float32)
    >>> image = project_points(cloud, np.ones(2, bool), Sensor("two", (0.1, 0.0), 8), num_rounds=2)
    >>> image.point_index.max(axis=(0, 1)).tolist()
    [1, 0]
    """
    if points.shape[1] < sensor.point_columns:
        raise ValueError(
            f"points: got {points.shape[1]} columns, sensor {sensor.name!r} needs {sensor.point_columns}"
        )
    rows, columns = sensor.num_rows, sensor.num_columns
    cloud, counts = jnp.asarray(points), jnp.asarray(valid)
    cell, angles = image_cells(cloud, counts, sensor)
    keys = priority_keys(angles[0], cloud[:, 4], prioritize_current=prioritize_current)
    index = winners(cell, keys, num_cells=rows * columns, num_rounds=num_rounds)
    features = _gather_channels(cloud, angles, index)
    return RangeImage(
        features=features.reshape(rows, columns, 9, num_rounds),
        point_index=index.reshape(rows, columns, num_rounds),
        num_dropped=jnp.sum(counts & (cell == rows * columns), dtype=jnp.int32),
    )


def _gather_channels(
    points: Float32[Array, "n c"], angles: tuple[Float32[Array, "n"], ...], index: Int32[Array, "s r"]
) -> Float32[Array, "s 9 r"]:
    """The nine channels of the winners, in the order of ``types.CHANNELS``; zero where empty."""
    x, y, z, intensity, lag = (points[:, i] for i in range(5))
    filled = index >= 0
    chosen = jnp.where(filled, index, 0)
    # One by one: side by side they would be written out for all points first.
    channels = (x, y, z, *angles, intensity, jnp.ones_like(x), lag)
    return jnp.stack([jnp.where(filled, channel[chosen], 0.0) for channel in channels], axis=1)
