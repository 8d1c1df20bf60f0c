"""The cloud policy of training and inference: which points are removed, truncated and reported."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.point_files import MAX_TIME_LAG_S, check_num_lags, check_time_lags, rank_lasers
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.projection import close_to_sensor, image_cells, remove_close
from fcos_lidar_jax.sensors import Sensor

MAX_INTENSITY = 65_535.0
"""On the scale 0-255; unscaled 16-bit counts reach it. One value of 1e30 would leave an infinite running variance
in the network."""

_SEED = 0  # of the random choice of truncated rows
_ORDER = "older sweeps go first, then random points"
_BLOCK = 4096  # rows that are projected together
_MAX_INTENSITY_READ = 255  # of all detectors
_MIN_ROWS = 500  # too few rows say nothing about the sensor
_NEAR_M = 2.0  # points on the ego vehicle say nothing about the sensor
_MAX_BEYOND = 0.9
_MAX_OUTSIDE = 0.3
_MAX_DENSITY = 1.7
_MIN_NEIGHBOURS = 0.3
_MIN_ROWS_FILLED, _MIN_ROWS_DOWN = 0.6, 0.9
"""The bounds of :func:`sensor_mismatch`. A sensor's own clouds reach at most 0.17, 0.01, 1.05, and at least 0.84,
0.96 in a street and 1. For most pairs of presets, one figure lies clearly on the other side; some have beams that
are too alike."""
_MIN_DESCENDING = 0.7  # share of neighbouring lasers in order; lasers in no order reach a half
_DOWN_RAD = -0.05  # beams below reach the ground or something before it; others may only see the sky


@dataclasses.dataclass(frozen=True)
class Cloud:
    """A cloud as detectors take it, padded to ``config.max_points`` rows."""

    points: np.ndarray
    """f32[max_points, c]: x, y, z (m), intensity (0-255), time lag (s), and the laser number for sensors that need
    it. Row order is preserved, row numbers unless rows were truncated; padding rows are zero."""
    valid: np.ndarray  # bool[max_points]: False for removed rows and padding
    num_points: int  # rows of the input, including rows that the reader removed
    num_close: int  # rows on the ego vehicle, removed here or by the reader
    num_invalid: int  # rows removed because they were not finite or beyond physical limits
    num_truncated: int  # rows removed because there were more than ``config.max_points``

    @property
    def num_removed(self) -> int:
        return self.num_close + self.num_invalid + self.num_truncated


def make_cloud(points: np.ndarray, config: Config, *, sensor: Sensor, num_close: int | None = None) -> Cloud:
    """Remove invalid and close points, and truncate or pad to ``config.max_points`` rows.

    If too many rows are left, rows of the oldest sweeps are dropped first. In the sweep at the limit, possibly the
    current one, rows are dropped at random by a fixed seed. All clouds have one shape, so nothing is recompiled.

    Args:
        points: f32[n, 3 to 6]: x, y, z, intensity (0-255), time lag (s), laser number. Missing intensities and
            lags become 0; columns that the sensor does not use are dropped.
        config: gives ``max_points`` and ``reading``.
        sensor: sensor that recorded the points.
        num_close: points on the ego vehicle that the reader removed, in each sweep's own frame; None if no
            reader was used: close points are then removed here, and the time lags are checked.

    Raises:
        ValueError: wrong number of columns; more time lags than ``config.num_sweeps``; without a reader also a
            fifth column of something else, see :func:`~fcos_lidar_jax.data.point_files.check_time_lags`.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> cloud = make_cloud(np.array([[9, 0, 0], [0, 9, np.inf], [0, 0, 0]]), QUICKSTART, sensor=SHORT_RANGE)
    >>> cloud.points.shape, cloud.valid[:3].tolist(), cloud.num_invalid, cloud.num_close
    ((4096, 5), [True, False, False], 1, 1)
    """
    points = _with_columns(points, sensor)
    valid = kept = np.asarray(usable_rows(points))
    by_reader = num_close or 0
    if num_close is None:
        check_time_lags(points[:, 4])
        kept = np.asarray(remove_close(points, valid, sensor, config.reading))
        num_close = int((valid & ~kept).sum())
    check_num_lags(points[:, 4], num_sweeps=config.num_sweeps)
    padded = np.zeros((config.max_points, points.shape[1]), np.float32)
    padded_valid = np.zeros(config.max_points, bool)
    num_truncated = write_points([points], kept, padded, padded_valid)
    num_points, num_invalid = len(points) + by_reader, int((~valid).sum())
    return Cloud(padded, padded_valid, num_points, num_close, num_invalid, num_truncated)


def _with_columns(points: np.ndarray, sensor: Sensor) -> np.ndarray:
    points = np.asarray(points, np.float32)
    laser = sensor.row_source == "laser"
    if points.ndim != 2 or not (6 if laser else 3) <= points.shape[1] <= 6:
        raise ValueError(
            f"points: got shape {points.shape}, expected [n, {'6' if laser else '3 to 6'}]: x, y, z, intensity, "
            f"time lag, laser number"
        )
    columns = sensor.point_columns
    return np.pad(points[:, :columns], ((0, 0), (0, max(columns - points.shape[1], 0))))


def usable_rows(points: np.ndarray | Array) -> np.ndarray | Array:
    """Which rows of f32[n, 5 or 6] are finite and within physical limits: bool[n], NumPy or JAX like the input.

    >>> usable_rows(np.array([[1, 2, 0, 255, 0.45], [1, 2, 0, 1e30, 0], [1, np.nan, 0, 0, 0]])).tolist()
    [True, False, False]
    """
    lag, finite = points[:, 4], points.__array_namespace__().isfinite(points)
    usable = (abs(points[:, 3]) <= MAX_INTENSITY) & (lag >= 0) & (lag <= MAX_TIME_LAG_S)
    if isinstance(points, np.ndarray) and finite.all():  # far faster than `all` per row
        return usable
    return usable & finite.all(axis=1)


def write_points(parts: Sequence[np.ndarray], kept: np.ndarray, points: np.ndarray, valid: np.ndarray) -> int:
    """Write a cloud's rows into zeroed arrays of a fixed size and count truncated rows; see :func:`make_cloud`.

    Args:
        parts: f32[n, c] each, written one after another.
        kept: bool[n of all parts]; if everything fits, the other rows are written too, as invalid.
        points, valid: outputs f32[m, c] and bool[m].
    """
    num_truncated = 0
    if len(kept) > len(points):
        cloud, number = np.concatenate(parts)[kept], len(points)
        newest = np.ones(len(cloud), bool)
        if len(cloud) > number:  # the newest sweeps, and random rows of the sweep at the boundary
            lags = cloud[:, 4]
            boundary = np.partition(lags, number)[number]
            newest = lags < boundary
            shuffled = np.random.default_rng(_SEED).permutation(np.flatnonzero(lags == boundary))
            newest[shuffled[: number - np.count_nonzero(newest)]] = True
        parts, kept = [cloud[newest]], np.ones(np.count_nonzero(newest), bool)
        num_truncated = len(cloud) - len(kept)
    np.concatenate(parts, out=points[: len(kept)])
    valid[: len(kept)] = kept
    return num_truncated


def no_usable_points(name: str | Path, cloud: Cloud, num_dropped: int, sensor: Sensor) -> str | None:
    """A line about a cloud without a point in the range image, because the projection dropped all valid rows, or
    None."""
    if np.count_nonzero(cloud.valid) > num_dropped:
        return None
    if not cloud.num_points:
        return f"{name}: no points in it, expected at least one"
    return (
        f"{name}: none of its {cloud.num_points} points is usable ({cloud.num_invalid} not finite or beyond "
        f"physical limits, {cloud.num_close} on the ego vehicle, the others out of range or view), expected some "
        f"with {_limits(sensor)} in the field of view of {sensor.name}"
    )


def unusable_cloud(
    name: str | Path, points: np.ndarray, valid: np.ndarray, num_close: int, sensor: Sensor
) -> str | None:
    """The line of :func:`no_usable_points` about f32[n, c] of a reader that removed ``num_close`` points.

    ``valid`` is the result of :func:`usable_rows`. Later rows are only projected if none of the first rows is in
    the range image, which is rare.
    """
    num_cells, num_valid = sensor.num_rows * sensor.num_columns, int(valid.sum())
    for start in range(0, len(points), _BLOCK):
        rows = slice(start, start + _BLOCK)
        if (_cells(points[rows], valid[rows], sensor, _BLOCK) < num_cells).any():
            return None
    num_invalid = len(points) - num_valid
    cloud = Cloud(points, valid, len(points) + num_close, num_close, num_invalid, num_truncated=0)
    return no_usable_points(name, cloud, num_valid, sensor)


def unusable_clouds(lines: Sequence[str], number: int, without: str = "boxes") -> str | None:
    """A line about the clouds of :func:`no_usable_points` among a number of clouds, or None.

    Raises:
        ValueError: the first line, if no cloud has usable points.
    """
    if not lines:
        return None
    if len(lines) == number:
        raise ValueError(lines[0])
    first = "" if len(lines) == 1 else "the first is "
    return f"{len(lines)} of {number} clouds without usable points, and so without {without}: {first}{lines[0]}"


def truncation(number: int, config: Config) -> str | None:
    """A line about the truncated points of all clouds, or None."""
    how = f"left out in total: the detector takes at most {config.max_points} per cloud (max_points)"
    return f"{number} points {how}; {_ORDER}" if number else None


def tell_truncation(name: str, cloud: Cloud, config: Config) -> None:
    """Print a line about the first truncated cloud, once per process; :func:`truncation` counts the points."""
    if cloud.num_truncated:
        usable = cloud.num_points - cloud.num_close - cloud.num_invalid
        left_out = f"{cloud.num_truncated} of {usable} usable points of {name} are left out"
        limit = f"the detector takes at most {config.max_points} (max_points)"
        tell(f"clouds are truncated: {left_out}, since {limit}; {_ORDER}", once="truncated")


def _limits(sensor: Sensor) -> str:
    low, high = sensor.limit_z_m
    return f"|x|, |y| < {sensor.limit_xy_m:g} m and {low:g} < z < {high:g} m"


def sensor_mismatch(points: np.ndarray, sensor: Sensor) -> str | None:
    """A warning that another sensor probably recorded a cloud, or that it has no current sweep, or None.

    Uses the current sweep: the share of points beyond the sensor's limits and outside its vertical field of view,
    points per image cell, the share of points with a neighbour in the next column and in the next row, of rows
    with points, the order of the lasers, and the scale of the intensity.

    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E, SHORT_RANGE
    >>> from fcos_lidar_jax.simulation.frames import make_frame
    >>> cloud = make_frame(0, NUSCENES_HDL32E).points
    >>> sensor_mismatch(cloud, NUSCENES_HDL32E)
    >>> sensor_mismatch(cloud, SHORT_RANGE)[:68]
    "points do not fit sensor 'short_range' (32 rows, 128 columns): 7.7 p"
    """
    points = _with_columns(points, sensor)
    points = points[usable_rows(points)]
    newest = points[:, 4].min(initial=MAX_TIME_LAG_S)
    if len(points) and newest > 0:
        return f"no points of the current sweep: the smallest time lag is {newest:g} s, expected 0"
    points = points[points[:, 4] == newest]
    points = points[~np.asarray(close_to_sensor(points, sensor, _NEAR_M))]
    if sensor.azimuth_limits_rad is not None:
        x, y = points[:, 0] - sensor.origin_m[0], points[:, 1] - sensor.origin_m[1]
        behind = (sensor.first_azimuth_rad - np.arctan2(y, x)) % (2 * np.pi)
        points = points[behind < sensor.num_columns * sensor.column_rad]
    if len(points) < _MIN_ROWS:
        return None
    if not (reason := "; ".join(_mismatch(points, sensor))):
        return None
    about = f"sensor {sensor.name!r} ({sensor.num_rows} rows, {sensor.num_columns} columns)"
    return f"points do not fit {about}: {reason}; expect poor detections"


def _mismatch(points: np.ndarray, sensor: Sensor) -> Iterator[str]:
    """All findings, except for those that too few points within the sensor's limits cannot show."""
    if (most := points[:, 3].max()) <= 1:
        yield "no intensity is above 1, expected 0 to 255" + (
            ": multiply them by 255 (--intensity-scale 255, or intensity_scale of the data's sensor)"
            if most > 0
            else ""
        )
    if np.median(points[:, 3]) > _MAX_INTENSITY_READ:
        yield f"most intensities are above {_MAX_INTENSITY_READ}, expected 0 to {_MAX_INTENSITY_READ}"
    low, high = sensor.limit_z_m
    within = (np.abs(points[:, :2]) < sensor.limit_xy_m).all(axis=1) & (points[:, 2] > low) & (points[:, 2] < high)
    beyond = 1 - within.mean()
    if beyond > _MAX_BEYOND:
        yield f"{beyond:.0%} of the points lie beyond its limits, {_limits(sensor)}"
        if within.sum() < _MIN_ROWS:
            return
    # Padded to a power of two, so that clouds of any length need few compilations.
    cell = _cells(points, within, sensor, 1 << (len(points) - 1).bit_length())
    cells = np.bincount(cell[within], minlength=sensor.num_rows * sensor.num_columns + 1)
    outside = cells[-1] / within.sum()
    if outside > _MAX_OUTSIDE:
        yield f"{outside:.0%} of the points lie outside its vertical field of view"
    if not cells[:-1].any():
        return
    filled = cells[:-1].reshape(sensor.num_rows, sensor.num_columns) > 0
    density = cells[:-1].sum() / filled.sum()
    if density > _MAX_DENSITY:
        yield f"{density:.1f} points per cell, expected about 1, with the origin in the sensor"
    beside = (filled & np.roll(filled, 1, axis=1)).sum() / filled.sum()
    below = (filled[1:] & filled[:-1]).sum() / filled.sum()
    for share, what in ((beside, "column"), (below, "row")):
        if share < _MIN_NEIGHBOURS:
            yield f"{share:.0%} of the points have a neighbour in the next {what}, expected most"
    if sensor.row_source == "laser":
        _, one = np.unique(points[:, 5], return_index=True)
        follows = np.diff(rank_lasers(points, sensor)[one, 5]) > 0
        if follows.sum() < _MIN_DESCENDING * len(follows):
            yield f"{follows.mean():.0%} of the lasers lie above the next, expected all: number them from the top"
    in_row, down = filled.sum(axis=1), np.asarray(sensor.inclinations_rad) < _DOWN_RAD
    rows = in_row > in_row.max() / 10
    if rows.mean() < _MIN_ROWS_FILLED and rows[down].sum() < _MIN_ROWS_DOWN * down.sum():
        yield f"only {rows.sum()} of {len(rows)} rows have points: the cloud has far fewer beams"


def _cells(points: np.ndarray, valid: np.ndarray, sensor: Sensor, size: int) -> np.ndarray:
    """:func:`~fcos_lidar_jax.projection.image_cells` i32[n], compiled once for up to ``size`` points."""
    padding = (0, size - len(points))
    cells, _ = image_cells(np.pad(points, (padding, (0, 0))), np.pad(valid, padding), sensor)
    return np.asarray(cells)[: len(points)]
