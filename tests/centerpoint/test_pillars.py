"""Pillars against loops over points; exact in any order."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.centerpoint import PillarConfig
from fcos_lidar_jax.centerpoint.pillars import (
    Grid,
    cell_maxima,
    cell_positions,
    cells_below,
    from_cell_means,
    make_pillars,
    pillar_grid,
)
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, sector

GRID = Grid(16, 0.5, (-3.0, -4.0))
SENSOR = dataclasses.replace(NUSCENES_HDL32E, limit_xy_m=4.5)


def cloud(number=600, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-6, -6, -6, 0, 0), (6, 6, 4, 255, 0.5), (number, 5)).astype(np.float32)
    points[:4, 0] = (np.nan, np.inf, 1e30, -1e30)
    points[5:9] = points[5]  # equal points
    return points, rng.random(number) > 0.2


def by_loops(points, valid):
    """Cell and ten features of every point, in float64."""
    cells, members = np.full(len(points), GRID.num_cells), {}
    for i, p in enumerate(points.astype(np.float64)):
        if not valid[i] or not np.isfinite(p).all() or max(abs(p[0]), abs(p[1])) >= 4.5 or not -5 < p[2] < 3:
            continue
        column, row = (math.floor((p[a] - GRID.low_m[a]) / GRID.cell_m) for a in (0, 1))
        if 0 <= column < GRID.side and 0 <= row < GRID.side:
            cells[i] = row * GRID.side + column
            members.setdefault(cells[i], []).append(i)
    features = np.zeros((len(points), 10))
    for cell, rows in members.items():
        mean = points[rows, :3].astype(np.float64).mean(axis=0)
        axis = [GRID.low_m[a] + ((cell % GRID.side, cell // GRID.side)[a] + 0.5) * GRID.cell_m for a in (0, 1)]
        for i in rows:
            features[i] = [*points[i], *(points[i, :3] - mean), *(points[i, :2] - axis)]
    return cells, features


def test_pillars_equal_loops_also_under_vmap():
    points, valid = cloud()
    cells, features = by_loops(points, valid)
    make = functools.partial(make_pillars, grid=GRID, sensor=SENSOR)
    found = jax.jit(make)(points, valid)
    assert found.cell.tolist() == cells.tolist()
    np.testing.assert_allclose(found.features, features, atol=2e-5)
    assert int(found.num_dropped) == np.count_nonzero(valid & (cells == GRID.num_cells)) > 0
    several = jax.jit(jax.vmap(make))(np.stack([points, points[::-1]]), np.stack([valid, valid[::-1]]))
    np.testing.assert_array_equal(several.features[0], found.features)
    np.testing.assert_array_equal(several.features[1][::-1], found.features)  # bit for bit, in any order


def test_a_laser_column_is_ignored_and_nothing_may_be_there():
    points, valid = cloud()
    wide = np.concatenate([points, np.full((len(points), 1), 7, np.float32)], axis=1)
    a, b = (make_pillars(p, valid, grid=GRID, sensor=SENSOR) for p in (points, wide))
    np.testing.assert_array_equal(a.features, b.features)
    nothing = make_pillars(points, np.zeros(len(points), bool), grid=GRID, sensor=SENSOR)
    assert not nothing.features.any()
    assert (nothing.cell == GRID.num_cells).all()
    assert int(nothing.num_dropped) == 0


def test_points_beside_the_sector_of_a_sensor_are_in_no_pillar():
    points, valid = cloud()
    ahead = sector(SENSOR, math.pi / 2, 272)
    right, left = ahead.azimuth_limits_rad
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    inside = (azimuth > right) & (azimuth < left)
    expected = make_pillars(points, valid & inside, grid=GRID, sensor=SENSOR)
    found = make_pillars(points, valid, grid=GRID, sensor=ahead)
    np.testing.assert_array_equal(found.cell, expected.cell)
    np.testing.assert_array_equal(found.features, expected.features)
    assert 10 < (np.asarray(found.cell) < GRID.num_cells).sum() < 0.5 * valid.sum()


def test_means_of_many_far_points_are_exact():
    """300,000 points of one cell: sums in float32 would be off by metres."""
    values = jnp.full((300_000, 1), 100.125).at[::2].add(0.25)
    found = from_cell_means(values, jnp.zeros(len(values), jnp.int32), 1)
    assert set(found[:, 0].tolist()) == {-0.125, 0.125}


def test_maxima_equal_a_loop_and_equal_rows_share_the_gradient():
    rng = np.random.default_rng(1)
    values, cell = rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 9, 50)
    values[cell == 4] = 2.5
    expected = np.zeros((9, 3), np.float32)
    for row, c in zip(values, cell, strict=True):
        expected[c] = np.maximum(expected[c], row)
    index = jnp.asarray(cell, jnp.int32)
    np.testing.assert_array_equal(cell_maxima(jnp.array(values), index, 8), expected)
    gradient = jax.grad(lambda v: cell_maxima(v, index, 8)[4].sum())(jnp.array(values))
    np.testing.assert_allclose(gradient[cell == 4], 1 / (cell == 4).sum(), rtol=1e-6)
    assert not gradient[cell != 4].any()


def test_axes_belong_to_the_cells_below():
    cell, inside = cells_below(cell_positions(jnp.arange(GRID.num_cells), GRID, part=0.5), GRID)
    assert cell.tolist() == list(range(GRID.num_cells))
    assert inside.all()


def test_the_grid_lies_around_the_sensor():
    sensor = dataclasses.replace(NUSCENES_HDL32E, origin_m=(1.5, -0.5, 1.8))
    assert pillar_grid(PillarConfig(range_m=8.0), sensor) == Grid(80, 0.2, (-6.5, -8.5))
