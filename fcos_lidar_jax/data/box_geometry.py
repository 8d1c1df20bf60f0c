"""Box geometry on the host: plausibility, overlap in the ground plane, and the points inside boxes."""

from collections.abc import Callable

import numpy as np

from fcos_lidar_jax.geometry import points_in_box

LIMITS = dict.fromkeys("xyz", 1e4) | dict.fromkeys("lwh", 500.0) | {"yaw": 8 * np.pi, "vx": 500.0, "vy": 500.0}
"""Field of a box -> largest plausible magnitude: metres, radians (larger yaws are degrees), metres per second."""
_CELL_M = 0.5
_MAX_CELLS = 1024  # per side: a box far away makes the cells larger instead of the grid
_SLACK_M = 1e-3  # far above float32 rounding, so that the coarse tests never lose an inside point


def check_boxes(boxes: np.ndarray, place: Callable[[int], str]) -> None:
    """Refuse implausible boxes: a single one would make all weights NaN.

    Args:
        boxes: [m, 9], ``x, y, z, l, w, h, yaw, vx, vy``; an unknown velocity is NaN twice.
        place: row -> name of a box, for messages.
    """
    good = np.abs(boxes) <= list(LIMITS.values())
    good[:, 3:6] &= boxes[:, 3:6] >= np.finfo(np.float32).tiny
    good[:, 7:] |= np.isnan(boxes[:, 7:]).all(axis=1, keepdims=True)
    if good.all():
        return
    row, column = np.argwhere(~good)[0]
    name = list(LIMITS)[column]
    kind = "a size above 0 m" if name in ("l", "w", "h") else "a finite number"
    unit = " radians" if name == "yaw" else ""
    expected = f"{kind}, at most {LIMITS[name]:g}{unit}"
    raise ValueError(f"{place(int(row))}: {name}: got {boxes[row, column]:g}, expected {expected}")


def footprints_overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether the rotated rectangles of boxes share area, bool[...]; elementwise with broadcasting.

    Touching does not count. Uses separating axes in float64.

    Args:
        a, b: [..., >= 7], ``x, y, z, l, w, h, yaw, ...``.

    >>> car = np.array([0, 0, 0, 4, 2, 1.5, 0.0])
    >>> footprints_overlap(car, car + np.array([[3.0], [4.0]]) * [1, 0, 0, 0, 0, 0, 0]).tolist()
    [True, False]
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    turn = b[..., 6] - a[..., 6]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    apart = np.zeros(turn.shape, bool)
    for own, other in ((a, b), (b, a)):
        axis_x, axis_y = np.cos(own[..., 6]), np.sin(own[..., 6])
        along, across = np.abs(axis_x * dx + axis_y * dy), np.abs(axis_x * dy - axis_y * dx)
        l, w = other[..., 3], other[..., 4]
        apart |= 2 * along >= own[..., 3] + l * cos + w * sin
        apart |= 2 * across >= own[..., 4] + l * sin + w * cos
    return ~apart


def count_inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Points inside each upright box, boundary included, i32[m]."""
    return np.array([len(rows) for rows in points_in_boxes(points, boxes)], np.int32)


def points_in_boxes(points: np.ndarray, boxes: np.ndarray) -> list[np.ndarray]:
    """Rows of the points inside each upright box, boundary included: one ascending i64 array per box.

    Looks up all points in a coarse grid of the ground and tests only the points near a box exactly, in float64.

    Args:
        points: [n, >= 3], metres; non-finite points are in no box.
        boxes: [m, >= 7], ``x, y, z, l, w, h, yaw, ...``.

    >>> box = np.array([[0, 0, 0, 4, 2, 2, 0.0]])
    >>> [rows.tolist() for rows in points_in_boxes(np.array([[1.0, 0, 0], [3.0, 0, 0], [-2.0, 1, 1]]), box)]
    [[0, 2]]
    """
    boxes = np.asarray(boxes, np.float64)
    if not len(points) or not len(boxes):
        return [np.zeros(0, np.int64) for _ in boxes]
    cos, sin = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    l, w = boxes[:, 3], boxes[:, 4]
    # Half the sides of the axis-aligned rectangle around each footprint, f64[m, 2].
    reach = np.stack([l * cos + w * sin, l * sin + w * cos], axis=1) / 2 + _SLACK_M
    near = _near_boxes(points, boxes[:, :2], reach)
    near = near[np.argsort(points[near, 0], kind="stable")]
    x = points[near, 0].astype(np.float64)
    first = np.searchsorted(x, boxes[:, 0] - reach[:, 0], side="left")
    last = np.searchsorted(x, boxes[:, 0] + reach[:, 0], side="right")
    found = []
    for box, i, j in zip(boxes, first, last, strict=True):
        rows = near[i:j]
        inside = points_in_box(points[rows, :3].astype(np.float64), box)
        found.append(np.sort(rows[np.asarray(inside)]))
    return found


def _near_boxes(points: np.ndarray, centres: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Rows of the points in grid cells that some box touches, ascending."""
    low, high = (centres - reach).min(axis=0), (centres + reach).max(axis=0)
    cell_m = max(_CELL_M, float((high - low).max()) / _MAX_CELLS)
    # One free cell around everything takes the points outside.
    low -= cell_m
    shape = ((high - low) / cell_m).astype(np.int64) + 2
    occupied = np.zeros(shape, bool)
    begin = ((centres - reach - low) / cell_m).astype(np.int64)
    end = ((centres + reach - low) / cell_m).astype(np.int64) + 1
    for (i, j), (k, l) in zip(begin, end, strict=True):
        occupied[i:k, j:l] = True
    cells = []
    for axis in (0, 1):
        with np.errstate(over="ignore", invalid="ignore"):  # far or non-finite points
            cell = (points[:, axis] - points.dtype.type(low[axis])) * points.dtype.type(1 / cell_m)
        # fmax and fmin turn NaN into a number, so that the conversion is defined.
        np.fmax(cell, 0, out=cell)
        np.fmin(cell, shape[axis] - 1, out=cell)
        cells.append(cell.astype(np.int32))
    return np.flatnonzero(occupied.ravel().take(cells[0] * np.int32(shape[1]) + cells[1]))


def transform_boxes(boxes: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform boxes f32[m, 9] by a pose f64[4, 4] to f64[m, 9]; ignores the tilt of headings.

    >>> quarter = np.array([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    >>> transform_boxes(np.array([[10.0, 0, 0, 4, 2, 1, 0, 8, 0]]), quarter).round(4).tolist()
    [[5.0, 10.0, 0.0, 4.0, 2.0, 1.0, 1.5708, 0.0, 8.0]]
    """
    moved, turn = np.array(boxes, np.float64), pose[:3, :3]
    moved[:, :3] = moved[:, :3] @ turn.T + pose[:3, 3]
    heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], axis=-1) @ turn[:2, :2].T
    moved[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    moved[:, 7:9] = moved[:, 7:9] @ turn[:2, :2].T
    return moved
