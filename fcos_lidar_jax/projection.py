"""Multi-round projection of points to a range image (paper, sections 3.1 and 3.2).

Each round keeps the point with the smallest key in each cell with a scatter-min; the remaining points enter the
next round. TPUs use one sort instead. Keys are exact and order all points: older sweep, then bits of the range,
then row of the input. The winners therefore do not depend on the execution order of a device, on batching, on
``jit`` or on the number of devices. They can depend on the platform: square roots, divisions and angles on CPUs,
GPUs and TPUs may differ in the last bit, which can move a point at the edge of a cell or change which of two
equally far points wins.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.forms import in_form, search
from fcos_lidar_jax.geometry import image_columns, spherical
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CHANNELS, RangeImage


def close_to_sensor(
    points: Float32[Array | np.ndarray, "n c"], sensor: Sensor, close_m: float
) -> Bool[Array | np.ndarray, "n"]:
    """Mask of the points on the ego vehicle: ``|x| < close_m`` and ``|y| < close_m`` around the sensor (static).

    NumPy input gives NumPy output, which filters clouds of any length on the host without compilation.

    >>> close_to_sensor(jnp.zeros((1, 5)), Sensor("two", (0.1, 0.0), 8), 1.0).tolist()
    [True]
    """
    with np.errstate(invalid="ignore"):  # signalling NaN
        x, y = points[:, 0] - sensor.origin_m[0], points[:, 1] - sensor.origin_m[1]
        return (abs(x) < close_m) & (abs(y) < close_m)


def remove_close(
    points: Float32[Array | np.ndarray, "n c"],
    valid: Bool[Array | np.ndarray, "n"],
    sensor: Sensor,
    reading: CloudReading,
) -> Bool[Array | np.ndarray, "n"]:
    """Mask of the ``valid`` points that are not on the ego vehicle, by their position in the current frame.

    Args:
        points: x, y, z, intensity, time lag. NumPy input gives NumPy output, JAX input gives JAX output.
        valid: False for padding.
        sensor: gives the position (static).
        reading: which sweeps lose their close points, and the size of the emptied square (static).

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
    """Image cell of each point; ``sensor`` is static.

    Row centres are the beams, with the highest beam in the top row. Columns run clockwise from azimuth pi, or from
    the left end of the sensor's sector. Points that are invalid, non-finite, outside the limits, outside the
    sector or more than half a row outside the field of view get the sentinel cell ``num_rows * num_columns``.

    Returns:
        row-major cells, and (range, azimuth, inclination) relative to the sensor, finite for points in the image.

    >>> two = Sensor("two", (0.1, 0.0), 8)
    >>> image_cells(jnp.array([[-5.0, 1e-3, 0, 0, 0]]), jnp.ones(1, bool), two)[0].tolist()
    [8]
    """
    # The barriers isolate the arithmetic, so that it rounds identically in every program that contains it.
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
    """Row of the nearest beam; a row outside the image for points outside the field of view."""
    step = sensor.even_step_rad
    if step is not None:
        top = np.float32(sensor.inclinations_rad[0])
        return jnp.floor((top - inclination) * np.float32(1 / step) + 0.5).astype(jnp.int32)
    edges = -np.asarray(sensor.row_edges_rad, np.float32)
    return search(jnp.asarray(edges), -inclination, side="right").astype(jnp.int32) - 1


def priority_keys(
    range_m: Float32[Array, "n"], time_lag: Float32[Array, "n"], *, prioritize_current: bool
) -> Array:
    """Exact 32-bit keys, smaller is better: older sweep (if ``prioritize_current``, static), then range.

    The bits of non-negative float32 values order like the values and leave the top bit free.

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
    """Index of the point that each cell keeps in each round (paper, section 3.2).

    Args:
        cell: row-major cells, ``num_cells`` for excluded points.
        keys: u32[n], smaller is better; the lower index wins among equal keys.
        num_cells, num_rounds: s and r (static).
        form: ``"scatter"`` runs one scatter-min per round, ``"sort"`` one sort of all points, with equal results
            (static). None selects the sort on TPUs, which have no 64-bit integers, and the scatter elsewhere.

    Returns:
        point index per cell and round, -1 where no point is left.

    >>> keys = jnp.array([7, 3, 5], jnp.uint32)
    >>> winners(jnp.array([0, 0, 0]), keys, num_cells=1, num_rounds=4).tolist()
    [[1, 2, 0, -1]]
    """
    sizes = {"num_cells": num_cells, "num_rounds": num_rounds}
    forms = {"scatter": functools.partial(_by_scatter, **sizes), "sort": functools.partial(_by_sort, **sizes)}
    return in_form(form, forms, cell, keys, tpu="sort", default="scatter")


def _by_scatter(cell: Array, keys: Array, *, num_cells: int, num_rounds: int) -> Array:
    # One word of key and index breaks ties within the scatter. 64-bit types are enabled for these words only.
    with jax.enable_x64(True):
        word = (keys.astype(jnp.uint64) << 32) | lax.iota(jnp.uint64, cell.shape[0])
        empty = jnp.uint64(np.iinfo(np.uint64).max)

        def one_round(left: Array, _: None) -> tuple[Array, Array]:
            best = jnp.full(num_cells + 1, empty).at[cell].min(left, mode="promise_in_bounds")
            return jnp.where(best[cell] >= left, empty, left), best[:num_cells]

        # A loop, because XLA recomputes the cell of each point in every unrolled round.
        _, kept = lax.scan(one_round, word, length=num_rounds)
        kept = kept.T
        index = (kept & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)
        return jnp.where(kept == empty, jnp.int32(-1), index)


def _by_sort(cell: Array, keys: Array, *, num_cells: int, num_rounds: int) -> Array:
    place = lax.iota(jnp.int32, cell.shape[0])
    cell, _, index = lax.sort((cell, keys, place), num_keys=3)
    first = lax.cummax(jnp.where(jnp.diff(cell, prepend=-1) != 0, place, 0))  # First place of the point's cell.
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
    """Project one cloud to a multi-round range image (paper, sections 3.1 and 3.2).

    Applies the sensor's range limits and field of view and drops non-finite rows. Keeps points on the ego vehicle,
    see :func:`remove_close`.

    Args:
        points: x, y, z (metres), intensity (0-255), time lag (seconds, exactly 0 for the current sweep), and the
            laser number as a sixth column for sensors with ``row_source="laser"``. A compiled function cannot
            refuse values: a ring in the fifth column would make current points old.
            :func:`~fcos_lidar_jax.data.cloud_policy.make_cloud` and detectors refuse it.
        valid: False for padding.
        sensor, num_rounds: geometry and number of rounds of the image (static).
        prioritize_current: points of the current sweep win every collision with older points (static).

    Returns:
        the image; ``point_index`` refers to rows of ``points``.

    Raises:
        ValueError: at trace time, for arrays of other shapes, if ``points`` has fewer columns than the sensor
            needs, or without a round.

    >>> import fcos_lidar_jax as fcos
    >>> sensor = fcos.load_sensor("short_range")  # a preset, or a file that describes your LiDAR
    >>> cloud = np.array([[0, 9, 0, 50, 0], [0, 5, 0, 60, 0]], np.float32)
    >>> image = project_points(cloud, np.ones(2, bool), sensor, num_rounds=2)
    >>> image.point_index.max(axis=(0, 1)).tolist()
    [1, 0]
    >>> compiled = jax.jit(project_points, static_argnames=("sensor", "num_rounds"))
    >>> compiled(cloud, np.ones(2, bool), sensor, num_rounds=2).features.shape
    (32, 128, 9, 2)
    """
    if points.ndim != 2 or valid.shape != points.shape[:1]:
        got = f"got shapes {points.shape} and {valid.shape}"
        raise ValueError(f"points, valid: {got}, expected (n, c) and (n,); use jax.vmap for batches")
    if points.shape[1] < sensor.point_columns:
        raise ValueError(
            f"points: got {points.shape[1]} columns, expected {sensor.point_columns} for sensor {sensor.name!r}"
        )
    check(num_rounds >= 1, "num_rounds", num_rounds, "at least 1")
    rows, columns = sensor.num_rows, sensor.num_columns
    if not points.shape[0]:  # one row of padding, because no row can be gathered from none
        points, valid = np.zeros((1, points.shape[1]), np.float32), np.zeros(1, bool)
    points, valid = jnp.asarray(points, jnp.float32), jnp.asarray(valid)
    cell, polar = image_cells(points, valid, sensor)
    keys = priority_keys(polar[0], points[:, 4], prioritize_current=prioritize_current)
    index = winners(cell, keys, num_cells=rows * columns, num_rounds=num_rounds)
    features = _gather_channels(points, polar, index)
    return RangeImage(
        features=features.reshape(rows, columns, len(CHANNELS), num_rounds),
        point_index=index.reshape(rows, columns, num_rounds),
        num_dropped=jnp.sum(valid & (cell == rows * columns), dtype=jnp.int32),
    )


def _gather_channels(
    points: Float32[Array, "n c"], polar: tuple[Float32[Array, "n"], ...], index: Int32[Array, "s r"]
) -> Float32[Array, "s _ r"]:
    """Channels of the winners in the order of ``types.CHANNELS``; zero in empty slots."""
    x, y, z, intensity, lag = (points[:, i] for i in range(5))
    filled = index >= 0
    row = jnp.where(filled, index, 0)
    # Gather one channel at a time: a joint gather would first materialize all channels of all points.
    channels = (x, y, z, *polar, intensity, jnp.ones_like(x), lag)
    return jnp.stack([jnp.where(filled, channel[row], 0.0) for channel in channels], axis=1)
