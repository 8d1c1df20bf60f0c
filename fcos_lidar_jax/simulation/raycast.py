"""First hits of a rotating fan of rays on solids and ground.

Only rays in the window of columns and rows spanned by a solid's bounding cuboid can hit the solid. The windows of
all solids form one flat list of (solid, ray) pairs, which is tested in one vectorised operation per kind of solid.
"""

import dataclasses
import functools

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.simulation.crossings import crossings, incidence
from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.solids import corners, enclosing


@dataclasses.dataclass(frozen=True)
class Fan:
    """Rays from one turn of a sensor, column by column, clockwise.

    Ray (column, row) has azimuth ``start - step * (column + delay[row])`` and the inclination of its row.
    """

    inclinations: np.ndarray  # f64[h], radians, decreasing: row 0 is the highest
    num_columns: int  # columns of the fan, which may span more than a full turn
    start: float  # azimuth of column 0, radians
    step: float  # width of a column, radians
    delay: np.ndarray  # f64[h]: firing time of each laser of a column, as a fraction of the column

    @functools.cached_property
    def directions(self) -> np.ndarray:
        """Unit vectors in the sensor's frame, f32[3, w * h], column by column."""
        azimuth = (self.start - self.step * (np.arange(self.num_columns)[:, None] + self.delay)).ravel()
        flat = np.tile(np.cos(self.inclinations), self.num_columns)
        up = np.tile(np.sin(self.inclinations), self.num_columns)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up]).astype(np.float32)


@dataclasses.dataclass(frozen=True)
class Hits:
    """First hit of each ray."""

    range_m: np.ndarray  # f32[w * h], column by column, inf without a hit
    solid: np.ndarray  # i32[w * h]: row of the solids, -1 for ground or no hit
    cosine: np.ndarray  # f32[w * h]: cosine of the angle of incidence
    reachable: np.ndarray  # i64[k]: owner * w * h + ray for each ray that would hit an owned object if unoccluded


def cast(
    fan: Fan, rotation: np.ndarray, origin: np.ndarray, solids: np.ndarray, ground: Ground, rng: Generator
) -> Hits:
    """First hits of all rays.

    Args:
        rotation: f64[3, 3], from sensor axes to world axes.
        origin: f64[3], position of the sensor in the world, above the ground.
        solids: [s], in the world frame.
    """
    d = rotation.astype(np.float32) @ fan.directions
    best, cosine = ground.first_hits(d, origin)
    solids = solids.copy()
    solids["center"] -= origin
    which, rays = _candidate_pairs(fan, rotation, solids)
    reach = crossings(solids, which, rays, d, rng)
    hit = np.flatnonzero(np.isfinite(reach))
    which, rays, reach = which[hit], rays[hit], reach[hit]
    owner = solids["owner"][which]
    owned = owner >= 0
    reachable = np.unique(owner[owned].astype(np.int64) * d.shape[1] + rays[owned])
    np.minimum.at(best, rays, reach)
    first = np.flatnonzero(reach == best[rays])
    winner = np.full(d.shape[1], -1, np.int32)
    winner[rays[first]] = which[first]
    struck = np.flatnonzero(winner >= 0)
    towards = d.take(struck, axis=1)
    cosine[struck] = incidence(solids, winner[struck], best[struck] * towards, towards)
    return Hits(best, winner, cosine, reachable)


def _candidate_pairs(fan: Fan, rotation: np.ndarray, solids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (solid, ray), i32[k], of the rays in the window of each solid."""
    low, high, left, right = _angular_bounds(rotation, solids)
    rising = fan.inclinations[::-1]
    last_row = len(rising) - 1 - np.searchsorted(rising, low - 1e-6)
    first_row = len(rising) - np.searchsorted(rising, high + 1e-6)
    turn = 2 * np.pi / fan.step
    first = (fan.start - left) / fan.step - float(fan.delay.max(initial=0)) - 1e-3
    last = (fan.start - right) / fan.step + 1e-3
    # Repeat each solid one turn earlier and later for windows that cross the first or last column.
    shift = turn * (np.array([[-1], [0], [1]]) - np.floor(first / turn))
    begin = np.ceil(np.maximum(first + shift, 0)).astype(np.int64).ravel()
    end = np.floor(np.minimum(last + shift, fan.num_columns - 1)).astype(np.int64).ravel()
    solid = np.tile(np.arange(len(solids), dtype=np.int32), 3)
    rows = np.tile(last_row - first_row + 1, 3)
    kept = (end >= begin) & (rows > 0)
    solid, begin, columns, rows = solid[kept], begin[kept], (end - begin + 1)[kept], rows[kept]
    strip_solid = np.repeat(solid, columns)
    strip_column = _ranges(begin, columns)
    strip_rows = np.repeat(rows, columns)
    strip_first = strip_column * len(fan.inclinations) + first_row[strip_solid]
    return np.repeat(strip_solid, strip_rows), _ranges(strip_first, strip_rows).astype(np.int32)


def _ranges(first: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Concatenate the ranges ``first[i], ..., first[i] + counts[i] - 1``."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(first - ends + counts, counts)


def _angular_bounds(rotation: np.ndarray, solids: np.ndarray) -> tuple[np.ndarray, ...]:
    """Lowest and highest inclination, left and right azimuth of each solid's cuboid in the sensor's frame."""
    local = corners(solids) @ rotation
    flat = np.hypot(local[..., 0], local[..., 1])
    # Least distance of the cuboid from the sensor's axis, from its footprint in the world.
    half = enclosing(solids)[:, :2]
    c, s = np.cos(solids["yaw"]), np.sin(solids["yaw"])
    x, y = solids["center"][:, 0], solids["center"][:, 1]
    offset = np.maximum(np.abs(np.stack([c * x + s * y, c * y - s * x], axis=1)) - half, 0)
    height = np.abs(local[..., 2]).max(axis=1)
    tilt = np.arccos(min(rotation[2, 2], 1.0))
    near = np.maximum(np.hypot(*offset.T) * np.cos(tilt) - height * np.sin(tilt), 1e-6)
    far = flat.max(axis=1)
    bottom, top = local[..., 2].min(axis=1), local[..., 2].max(axis=1)
    low = np.arctan2(bottom, np.where(bottom < 0, near, far))
    high = np.arctan2(top, np.where(top > 0, near, far))
    middle = local.mean(axis=1)
    toward = np.arctan2(middle[:, 1], middle[:, 0])
    away = wrap_angle(np.arctan2(local[..., 1], local[..., 0]) - toward[:, None])
    around = near < 1e-3
    left = toward + np.where(around, np.pi, away.max(axis=1))
    right = toward + np.where(around, -np.pi, away.min(axis=1))
    return low, high, left, right
