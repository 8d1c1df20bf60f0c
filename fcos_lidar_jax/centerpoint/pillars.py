"""Division of point clouds into pillars, and features of the points (PointPillars with dynamic pillars).

Neither points per pillar nor pillars per cloud are limited: points are combined by scatter operations, and
excluded points go to an additional last cell. Means are sums of integers and maxima are exact, so the result
depends neither on the device nor on the order of the points.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32

from fcos_lidar_jax.centerpoint.pillar_config import PillarConfig
from fcos_lidar_jax.centerpoint.types import Pillars
from fcos_lidar_jax.geometry import image_columns, spherical
from fcos_lidar_jax.sensors import Sensor

_STEPS_PER_M = 2.0**16  # Resolution of the integers in means, far finer than a LiDAR's.


@dataclasses.dataclass(frozen=True)
class Grid:
    """A square of square cells in the ground plane, row-major, with rows along y and columns along x."""

    side: int  # Cells along each axis.
    cell_m: float  # Side of a cell, metres.
    low_m: tuple[float, float]  # Minimum x and y of the square, metres.

    @property
    def num_cells(self) -> int:
        return self.side * self.side


def pillar_grid(config: PillarConfig, sensor: Sensor, *, stride: int = 1) -> Grid:
    """Create the grid of pillars around a sensor, or of cells with a side of ``stride`` pillars.

    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E
    >>> pillar_grid(PillarConfig(), NUSCENES_HDL32E, stride=4)
    Grid(side=128, cell_m=0.8, low_m=(-51.2, -51.2))
    """
    side = round(2 * config.range_m / config.pillar_m)
    low = tuple(origin - config.range_m for origin in sensor.origin_m[:2])
    return Grid(side // stride, config.pillar_m * stride, low)  # type: ignore[arg-type]


def cells_below(xy: Float[Array, "*n 2"], grid: Grid) -> tuple[Int32[Array, "*n"], Bool[Array, "*n"]]:
    """Find the cell of each position and whether it is on the grid; outside, the cell is the number of cells.

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
    """Compute x and y in metres of a cell's minimum corner, plus ``part`` of the cell's side along both axes.

    >>> cell_positions(jnp.array([2]), Grid(2, 1.0, (0.0, 0.0)), part=0.5).tolist()
    [[0.5, 1.5]]
    """
    # Looked up in a table, because programs differ in how they round the computation.
    x, y = (np.float32(low + (np.arange(grid.side + 1) + part) * grid.cell_m) for low in grid.low_m)
    return jnp.stack([jnp.asarray(x)[cell % grid.side], jnp.asarray(y)[cell // grid.side]], axis=-1)


def from_cell_means(
    values: Float32[Array, "n c"], cell: Int32[Array, "n"], num_cells: int
) -> Float32[Array, "n c"]:
    """Subtract from each row the mean over the rows of its cell, with a resolution of 1/65536.

    >>> from_cell_means(jnp.array([[1.0], [2.0], [9.0]]), jnp.array([0, 0, 1]), 2).tolist()
    [[-0.5], [0.5], [0.0]]
    """
    count = jnp.zeros(num_cells + 1, jnp.int32).at[cell].add(1)[cell]
    with jax.enable_x64(True):  # Only for the sums.
        steps = jnp.round(values * np.float32(_STEPS_PER_M)).astype(jnp.int64)
        total = jnp.zeros((num_cells + 1, values.shape[1]), jnp.int64).at[cell].add(steps)[cell]
        difference = (steps * count[:, None].astype(jnp.int64) - total).astype(jnp.float32)
    return difference / (count.astype(jnp.float32) * np.float32(_STEPS_PER_M))[:, None]


def cell_maxima(values: Float[Array, "n c"], cell: Int32[Array, "n"], num_cells: int) -> Float[Array, "_ c"]:
    """Compute the maximum over the rows of each cell, at least 0, and a last row for rows outside all cells.

    Equal rows share the gradient.

    >>> cell_maxima(jnp.array([[1.0], [2.0], [9.0]]), jnp.array([0, 0, 3]), 3).tolist()
    [[2.0], [0.0], [0.0], [9.0]]
    """
    start = jnp.zeros((num_cells + 1, values.shape[1]), values.dtype)
    return start.at[cell].max(values, mode="promise_in_bounds")


def make_pillars(
    points: Float32[Array | np.ndarray, "n c"], valid: Bool[Array | np.ndarray, "n"], *, grid: Grid, sensor: Sensor
) -> Pillars:
    """Find the pillar of each point of one cloud and compute its ten features (PointPillars, section 2.1).

    Drops non-finite rows and rows outside the grid, the sensor's limits or its sector. The vertical field of view
    and the lasers are ignored.

    Args:
        points: x, y, z (metres), intensity (0-255), time lag (seconds), and ignored columns.
        grid, sensor: pillars and limits (static).

    >>> cloud = np.array([[0.25, 0.5, 0, 9, 0], [0.75, 0.5, 1, 9, 0]], np.float32)
    >>> pillars = make_pillars(cloud, np.ones(2, bool), grid=Grid(2, 1.0, (0, 0)), sensor=Sensor("a", (0.1, 0), 8))
    >>> pillars.cell.tolist(), pillars.features[0, 5:].tolist()
    ([0, 0], [-0.25, 0.0, -0.5, -0.25, 0.0])
    """
    with jax.named_scope("pillars"):
        cloud, exists = jnp.asarray(points)[:, :5], jnp.asarray(valid)
        usable = exists & jnp.isfinite(cloud).all(axis=1)
        cloud = jnp.where(usable[:, None], cloud, 0.0)
        low, high = sensor.limit_z_m
        within_xy = (jnp.abs(cloud[:, :2]) < sensor.limit_xy_m).all(axis=1)
        usable &= within_xy & (cloud[:, 2] > low) & (cloud[:, 2] < high)
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
            num_dropped=jnp.sum(exists & ~usable, dtype=jnp.int32),
        )
