"""Points to pillars, and what the points of a pillar say to one image from above (PointPillars, dynamic pillars).

No pillar has a maximum of points and no cloud one of pillars: points are gathered by scatter, those that take no
part in a cell behind the last one. Means are sums of integers and maxima are exact, so the result depends neither
on the device nor on the order of the points.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32

from fcos_lidar_jax.centerpoint.config import PillarConfig
from fcos_lidar_jax.centerpoint.types import Pillars
from fcos_lidar_jax.geometry import image_columns, spherical
from fcos_lidar_jax.sensors import Sensor

_STEPS_PER_M = 2.0**16  # Of the integers that means are computed with: far below what a LiDAR can tell.


@dataclasses.dataclass(frozen=True)
class Grid:
    """A square of square cells, seen from above; row-major, rows by y and columns by x.

    Attributes:
        side: cells along each axis.
        cell_m: side of a cell, metres.
        low_m: least x and y of the square, metres.
    """

    side: int
    cell_m: float
    low_m: tuple[float, float]

    @property
    def num_cells(self) -> int:
        return self.side * self.side


def pillar_grid(config: PillarConfig, sensor: Sensor, *, stride: int = 1) -> Grid:
    """The pillars around a sensor, or the cells of ``stride`` pillars a side.

    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E
    >>> pillar_grid(PillarConfig(), NUSCENES_HDL32E, stride=4)
    Grid(side=128, cell_m=0.8, low_m=(-51.2, -51.2))
    """
    side = round(2 * config.range_m / config.pillar_m)
    low = tuple(origin - config.range_m for origin in sensor.origin_m[:2])
    return Grid(side // stride, config.pillar_m * stride, low)  # type: ignore[arg-type]


def cells_below(xy: Float[Array, "*n 2"], grid: Grid) -> tuple[Int32[Array, "*n"], Bool[Array, "*n"]]:
    """The cell below each position, and whether there is one; the number of cells where there is none.

    >>> cell, inside = cells_below(jnp.array([[0.5, 1.5], [-0.1, 0.0]]), Grid(2, 1.0, (0.0, 0.0)))
    >>> cell.tolist(), inside.tolist()
    ([2, 4], [True, False])
    """
    steps = (xy - np.asarray(grid.low_m, np.float32)) * np.float32(1 / grid.cell_m)
    inside = ((steps >= 0) & (steps < grid.side)).all(axis=-1)
    column_row = jnp.floor(jnp.where(inside[..., None], steps, 0.0)).astype(jnp.int32)
    cell = column_row[..., 1] * grid.side + column_row[..., 0]
    return jnp.where(inside, cell, grid.num_cells), inside


def cell_positions(cell: Int32[Array, "*n"], grid: Grid, *, part: float = 0.0) -> Float32[Array, "*n 2"]:
    """x and y of the corner of least x and y, or ``part`` of the cell away from it along both, metres.

    >>> cell_positions(jnp.array([2]), Grid(2, 1.0, (0.0, 0.0)), part=0.5).tolist()
    [[0.5, 1.5]]
    """
    # Looked up: computed, they would be rounded once in some programs and twice in others.
    x, y = (np.float32(low + (np.arange(grid.side + 1) + part) * grid.cell_m) for low in grid.low_m)
    return jnp.stack([jnp.asarray(x)[cell % grid.side], jnp.asarray(y)[cell // grid.side]], axis=-1)


def from_cell_means(
    values: Float32[Array, "n c"], cell: Int32[Array, "n"], num_cells: int
) -> Float32[Array, "n c"]:
    """Every row without the mean over the rows of its cell, to a 65536th of the unit.

    >>> from_cell_means(jnp.array([[1.0], [2.0], [9.0]]), jnp.array([0, 0, 1]), 2).tolist()
    [[-0.5], [0.5], [0.0]]
    """
    count = jnp.zeros(num_cells + 1, jnp.int32).at[cell].add(1)[cell]
    with jax.enable_x64(True):  # for the sums alone
        steps = jnp.round(values * np.float32(_STEPS_PER_M)).astype(jnp.int64)
        total = jnp.zeros((num_cells + 1, values.shape[1]), jnp.int64).at[cell].add(steps)[cell]
        difference = (steps * count[:, None].astype(jnp.int64) - total).astype(jnp.float32)
    return difference / (count.astype(jnp.float32) * np.float32(_STEPS_PER_M))[:, None]


def cell_maxima(values: Float[Array, "n c"], cell: Int32[Array, "n"], num_cells: int) -> Float[Array, "_ c"]:
    """The greatest values of the rows of each cell, 0 at least, and a last row for those of no cell.

    Equal rows share the gradient.

    >>> cell_maxima(jnp.array([[1.0], [2.0], [9.0]]), jnp.array([0, 0, 3]), 3).tolist()
    [[2.0], [0.0], [0.0], [9.0]]
    """
    start = jnp.zeros((num_cells + 1, values.shape[1]), values.dtype)
    return start.at[cell].max(values, mode="promise_in_bounds")


def make_pillars(
    points: Float32[Array | np.ndarray, "n c"], valid: Bool[Array | np.ndarray, "n"], *, grid: Grid, sensor: Sensor
) -> Pillars:
    """The pillar of every point of one cloud and its ten features (PointPillars, section 2.1).

    Drops non-finite rows and those outside of the grid, of the sensor's limits or of the sector that it covers;
    neither the vertical field of view nor the lasers matter.

    Args:
        points: x, y, z (metres), intensity (0-255), time lag (seconds), and columns that are ignored.
        valid: rows that count.
        grid, sensor: the pillars, and the limits (static).

    >>> cloud = np.array([[0.25, 0.5, 0, 9, 0], [0.75, 0.5, 1, 9, 0]], np.float32)
    >>> pillars = make_pillars(cloud, np.ones(2, bool), grid=Grid(2, 1.0, (0, 0)), sensor=Sensor("a", (0.1, 0), 8))
    >>> pillars.cell.tolist(), pillars.features[0, 5:].tolist()
    ([0, 0], [-0.25, 0.0, -0.5, -0.25, 0.0])
    """
    with jax.named_scope("pillars"):
        cloud, given = jnp.asarray(points)[:, :5], jnp.asarray(valid)
        usable = given & jnp.isfinite(cloud).all(axis=1)
        cloud = jnp.where(usable[:, None], cloud, 0.0)
        low, high = sensor.limit_z_m
        usable &= (
            (jnp.abs(cloud[:, :2]) < sensor.limit_xy_m).all(axis=1) & (cloud[:, 2] > low) & (cloud[:, 2] < high)
        )
        if sensor.azimuth_limits_rad is not None:
            _, azimuth, _ = spherical(cloud[:, :3] - np.asarray(sensor.origin_m, np.float32))
            usable &= image_columns(azimuth, sensor)[1]
        cell, inside = cells_below(cloud[:, :2], grid)
        usable &= inside
        cell = jnp.where(usable, cell, grid.num_cells)
        cloud = jnp.where(usable[:, None], cloud, 0.0)
        from_mean = from_cell_means(cloud[:, :3], cell, grid.num_cells)
        from_axis = cloud[:, :2] - cell_positions(cell, grid, part=0.5)
        features = jnp.concatenate([cloud, from_mean, from_axis], axis=1)
        return Pillars(
            features=jnp.where(usable[:, None], features, 0.0),
            cell=cell,
            num_dropped=jnp.sum(given & ~usable, dtype=jnp.int32),
        )
