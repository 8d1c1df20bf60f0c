"""Bird's-eye views of points, detections and truth."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.records import ScoredBoxes, TrueBoxes, one_per_object
from fcos_lidar_jax.visualization.figure import class_color, new_figure, save_png, set_title, write_labels

_SIZE_IN = 9.0
_DASHES = (0, (3, 2))
_LEGEND_CLASSES = 30
_HIGH_M = 3.0  # height above ground from which points have the darkest colour
_MARGIN_M = 2.0  # around a fitted view; also how far a full turn reaches at least to all sides
_TALLEST = 1.4  # height of a fitted view relative to its width, at most


def draw_bev(
    points: np.ndarray,
    path: str | Path,
    *,
    limit_m: float,
    classes: Sequence[str],
    detections: ScoredBoxes | None = None,
    truth: TrueBoxes | None = None,
    title: str | None = None,
) -> None:
    """Plot a cloud from above: x to the right, y up, higher points darker, a cross at the origin.

    Detections, one per object, have solid outlines in the colour of their class, with class and score, or only the
    score, where there is room, highest scores first. Truth has thin dashed black outlines filled with the colour
    of its class. A line from the centre through the front marks the heading. ``limit_m`` is half the side of the
    plotted square. If all points are to one side of the sensor, as in a camera image, the view is fitted to points
    and boxes.
    """
    boxes = [box for each in (detections, truth) if each is not None for box in each[0]]
    view = _fitted(points, boxes, limit_m)
    width_m, height_m = np.ptp(view, axis=1)
    figure = new_figure(_SIZE_IN, _SIZE_IN * float(np.clip(height_m / width_m, 1 / _TALLEST, _TALLEST)) + 0.5)
    options = {"limit_m": limit_m, "classes": classes, "detections": detections, "truth": truth}
    present = bev_on(figure.add_subplot(), points, view=view, **options)
    class_legend(figure, sorted(present), classes, detections=detections is not None, truth=truth is not None)
    if title:
        set_title(figure.axes[0], title, fontsize=11)
    save_png(figure, path)


def bev_on(
    axis: Any,
    points: np.ndarray,
    *,
    limit_m: float,
    classes: Sequence[str],
    detections: ScoredBoxes | None = None,
    truth: TrueBoxes | None = None,
    view: np.ndarray | None = None,
) -> set[int]:
    """Plot the view of :func:`draw_bev` on an axis, by default the whole square, else the limits of x and y
    f64[2, 2]; returns the visible labels."""
    view = np.array([[-limit_m, limit_m]] * 2) if view is None else view
    _draw_points(axis, points, limit_m)
    axis.plot(0, 0, marker="+", color="black", markersize=8, zorder=2)
    present: set[int] = set()
    for box, label in zip(*(truth or ()), strict=True):
        if _in_view(box, limit_m):
            axis.fill(*corners_from_above(box), color=class_color(label), alpha=0.3, linewidth=0, zorder=1)
            _outline(axis, box, limit_m, color="black", linewidth=0.9, linestyle=_DASHES, zorder=5)
            present.add(int(label))
    shown = () if detections is None else one_per_object(detections)
    visible = [d for d in zip(*shown, strict=True) if _in_view(d[0], limit_m)]
    for box, label, _ in visible:
        _outline(axis, box, limit_m, color=class_color(label), linewidth=1.7, zorder=4)
        present.add(int(label))
    axis.set(xlim=view[0], ylim=view[1], aspect="equal")
    width_m, height_m = np.ptp(view, axis=1)
    point_m = max(width_m, height_m / _TALLEST) / (0.88 * 72 * axis.get_figure().get_figwidth())
    labels = (
        (box[:2], np.ptp(corners_from_above(box), axis=1) / 2, label, score) for box, label, score in visible
    )
    write_labels(axis, labels, classes, (point_m, point_m))
    axis.set(xlabel="x [m]", ylabel="y [m]")  # the forward axis depends on the data set
    axis.grid(color="#eeeeee", linewidth=0.6)
    axis.set_axisbelow(True)
    return present


def _fitted(points: np.ndarray, boxes: Sequence[np.ndarray], limit_m: float) -> np.ndarray:
    """Limits of x and y, f64[2, 2]: the square, or what is in it of a cloud to one side of the sensor."""
    xy = _visible(points, limit_m)[:, :2]
    if not len(xy) or ((xy.min(axis=0) < -_MARGIN_M).all() and (xy.max(axis=0) > _MARGIN_M).all()):
        return np.array([[-limit_m, limit_m]] * 2)
    corners = [corners_from_above(box) for box in boxes if _in_view(box, limit_m)]
    shown = np.concatenate([np.zeros((2, 1)), xy.T, *corners], axis=1)  # with the cross at the origin
    low, high = shown.min(axis=1) - _MARGIN_M, shown.max(axis=1) + _MARGIN_M
    return np.stack([low, high], axis=1).clip(-limit_m, limit_m)


def _visible(points: np.ndarray, limit_m: float) -> np.ndarray:
    return points[np.isfinite(points[:, :3]).all(axis=1) & (np.abs(points[:, :2]) < limit_m).all(axis=1)]


def _draw_points(axis: Any, points: np.ndarray, limit_m: float) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    cloud = _visible(points, limit_m)
    if len(cloud):
        # Heights are relative to the ground: the ground is light and objects on it are dark.
        ground = np.quantile(cloud[:, 2], 0.1)
        dot = float(np.clip(3e4 / len(cloud), 1.6, 7))  # larger dots for sparse clouds
        shades = LinearSegmentedColormap.from_list("height", ["#c4c4c4", "#8aa0b8", "#3f5f86", "#1c1c3c"])
        colors = {"c": cloud[:, 2] - ground, "cmap": shades, "vmin": 0, "vmax": _HIGH_M}
        axis.scatter(*cloud[:, :2].T, s=dot, linewidths=0, zorder=2, **colors)


def _in_view(box: np.ndarray, limit_m: float) -> bool:
    reach = np.hypot(box[3], box[4]) / 2
    return bool(np.isfinite(box[:7]).all() and np.abs(box[:2]).max() < limit_m + reach)


def corners_from_above(box: np.ndarray) -> np.ndarray:
    """x and y of the closed outline from above, f64[2, 5], metres."""
    x, y, _, l, w, _, yaw = map(float, box[:7])
    cos, sin = np.cos(yaw), np.sin(yaw)
    along, across = np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]]) * [[l / 2], [w / 2]]
    return np.stack([x + cos * along - sin * across, y + sin * along + cos * across])


def _outline(axis: Any, box: np.ndarray, limit_m: float, **style: Any) -> None:
    axis.plot(*corners_from_above(box), **style)
    # The heading line extends beyond the front to stay visible on small boxes.
    x, y, reach, yaw = float(box[0]), float(box[1]), float(box[3]) / 2 + 0.008 * limit_m, float(box[6])
    axis.plot([x, x + np.cos(yaw) * reach], [y, y + np.sin(yaw) * reach], **{**style, "linestyle": "-"})


def class_legend(
    figure: Any, present: Sequence[int], classes: Sequence[str], *, detections: bool, truth: bool
) -> None:
    """Add a legend below the figure with the colours of the present classes and the styles of the outlines."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    listed, rest = present[:_LEGEND_CLASSES], len(present[_LEGEND_CLASSES:])
    entries: list[Any] = [Patch(color=class_color(k), label=classes[k].replace("_", " ")) for k in listed]
    entries += [Patch(color="white", label=f"and {rest} more")] if rest else []
    if detections:
        entries.append(Line2D([], [], color="#444444", linewidth=1.7, label="detection"))
    if truth:
        entries.append(Line2D([], [], color="black", linewidth=0.9, linestyle=_DASHES, label="truth"))
    if entries:
        legend = figure.legend(handles=entries, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
        for text in legend.get_texts():
            text.set_parse_math(False)
