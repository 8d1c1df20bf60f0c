"""What a sweep looks like in numbers: ground, rings, intensity, and what stands about that is no object."""

import numpy as np
from scipy import ndimage

from fcos_lidar_jax.data.box_geometry import points_in_boxes
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.projection import close_to_sensor, project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CHANNELS

Figures = dict[str, float]
_REACH_M = 40.0
_CELL_M = 1.0  # of the lowest points, for heights above ground and for roughness
_CLUTTER_CELL_M = 0.5
_SPANS_M = ((4, 12), (12, 20), (20, 35))
_BANDS_M = ((-np.inf, 0.25), (0.25, 0.6), (0.6, 1.2), (1.2, 2.0), (2.0, 3.0), (3.0, np.inf))
_LEAST_POINTS = 6  # of a cluster, and of a cell whose roughness counts
_MAX_POINTS = 40_960


def sweep_statistics(frame: Frame, sensor: Sensor) -> Figures:
    """Figures of one sweep without the points on the ego vehicle; metres, heights in the sensor's frame.

    "Above ground" is above the lowest point within a cell of a metre and its neighbours. Clusters are connected
    half-metre cells with points 0.3 to 3 m above ground, outside all boxes.
    """
    points = frame.points[~close_to_sensor(frame.points, sensor, 1.0)]
    away = np.hypot(points[:, 0], points[:, 1])
    points, away = points[away < sensor.limit_xy_m], away[away < sensor.limit_xy_m]
    inside = np.zeros(len(points), bool)
    for rows in points_in_boxes(points, frame.boxes):
        inside[rows] = True
    near = away < _REACH_M
    above = _above_ground(points, sensor.limit_xy_m)
    found = {"points": float(len(points)), "% in boxes": 100 * inside[near].mean()}
    for low, high in _SPANS_M:
        there = points[(away >= low) & (away < high), 2]
        found |= {f"z at {low}-{high} m, {q} %": np.percentile(there, q) for q in (2, 10, 25, 50, 75)}
    found |= _plane(points[(away > 3) & (away < 15) & (points[:, 2] < -0.9), :3])
    for low, high in _BANDS_M:
        share = ((above[near] >= low) & (above[near] < high)).mean()
        found[f"% {low:g} to {high:g} m above ground"] = 100 * share
    found |= _roughness(points[(away > 4) & (away < 20)])
    found |= _clusters(points[near & ~inside & (above > 0.3) & (above < 3)])
    found |= _image(points, sensor)
    found |= {f"intensity, {q} %": np.percentile(points[:, 3], q) for q in (10, 25, 50, 75, 90, 99)}
    shown = np.hypot(*frame.boxes[frame.num_points > 0, :2].T)
    counts, _ = np.histogram(shown, np.arange(0, 60, 10))
    found |= {f"boxes at {10 * i}-{10 * i + 10} m": n for i, n in enumerate(counts)}
    return {name: float(value) for name, value in found.items()}


def _above_ground(points: np.ndarray, limit_m: float) -> np.ndarray:
    cells = ((points[:, :2] + limit_m) / _CELL_M).astype(int)
    side = int(2 * limit_m / _CELL_M) + 1
    lowest = np.full((side, side), np.inf)
    np.minimum.at(lowest, tuple(cells.T), points[:, 2])
    return points[:, 2] - ndimage.minimum_filter(lowest, 3)[tuple(cells.T)]


def _plane(points: np.ndarray) -> Figures:
    """The plane of most points, as the sensor sees it: reweighted least squares."""
    matrix, fit = np.column_stack([points[:, :2], np.ones(len(points))]), np.array([0, 0, np.median(points[:, 2])])
    for _ in range(20):
        weight = 1 / (1 + ((points[:, 2] - matrix @ fit) / 0.05) ** 2)
        fit = np.linalg.lstsq(matrix * weight[:, None], points[:, 2] * weight, rcond=None)[0]
    return {"road rises ahead, rad": fit[1], "road rises to the right, rad": fit[0], "road below sensor": -fit[2]}


def _roughness(points: np.ndarray) -> Figures:
    """Deviation of the heights within cells of the ground that are nearly flat."""
    cells = np.floor(points[:, :2] / _CELL_M).astype(int)
    _, cell = np.unique(cells @ [10_000, 1], return_inverse=True)
    index = np.arange(cell.max() + 1)
    low, high = (extreme(points[:, 2], cell, index) for extreme in (ndimage.minimum, ndimage.maximum))
    flat = (high - low < 0.3) & (np.bincount(cell) >= _LEAST_POINTS)
    deviation = 100 * ndimage.standard_deviation(points[:, 2], cell, index)[flat]
    return {"deviation in flat cells, cm": np.median(deviation), "..., 90 %": np.percentile(deviation, 90)}


def _clusters(points: np.ndarray) -> Figures:
    cells = ((points[:, :2] + _REACH_M) / _CLUTTER_CELL_M).astype(int)
    side = int(2 * _REACH_M / _CLUTTER_CELL_M) + 1
    grid = np.zeros((side, side), bool)
    grid[tuple(cells.T)] = True
    labels = np.zeros_like(grid, int)
    ndimage.label(grid, np.ones((3, 3)), output=labels)
    many = np.bincount(labels[tuple(cells.T)], minlength=labels.max() + 1)[1:] >= _LEAST_POINTS
    sides = [[piece.stop - piece.start for piece in found] for found in ndimage.find_objects(labels)]
    extent = _CLUTTER_CELL_M * np.array(sides).reshape(-1, 2).max(axis=1)
    return {
        "clusters up to 1.5 m wide": (many & (extent <= 1.5)).sum(),
        "clusters of 1.5 to 6 m": (many & (extent > 1.5) & (extent <= 6)).sum(),
        "wider clusters": (many & (extent > 6)).sum(),
        "cells with clutter": grid.sum(),
    }


def _image(points: np.ndarray, sensor: Sensor) -> Figures:
    """How full every other row is, lowest first, and the noise along rows."""
    padded = np.pad(points, ((0, _MAX_POINTS - len(points)), (0, 0)))
    image = project_points(padded, np.arange(_MAX_POINTS) < len(points), sensor, num_rounds=1)
    filled = np.asarray(image.point_index[..., 0]) >= 0
    range_m = np.where(filled, np.asarray(image.features)[:, :, CHANNELS.index("range"), 0], np.nan)
    bend = np.abs(range_m[:, 2:] - 2 * range_m[:, 1:-1] + range_m[:, :-2])
    noise = 1.4826 * np.median(bend[bend < 0.15]) / np.sqrt(6)
    rows = filled[::-1].mean(axis=1)
    fill = {f"% of row {k} filled": 100 * rows[k : k + 2].mean() for k in range(0, sensor.num_rows, 2)}
    return fill | {"noise along a row, mm": 1000 * noise}
