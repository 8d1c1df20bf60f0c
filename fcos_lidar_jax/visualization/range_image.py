"""Pictures of multi-round range images."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.box_geometry import points_in_boxes
from fcos_lidar_jax.evaluation.records import ScoredBoxes, TrueBoxes, one_per_object
from fcos_lidar_jax.types import CHANNELS, RangeImage
from fcos_lidar_jax.visualization.figure import EMPTY, class_color, new_figure, save_png, set_title, write_labels

_RANGE, _INCLINATION, _INTENSITY, _EXISTENCE, _LAG = (
    CHANNELS.index(c) for c in ("range", "inclination", "intensity", "existence", "time_lag")
)
_WIDTH_IN, _PANEL_IN = 13.0, 1.5  # of the figure, and of a panel with its title


def draw_range_image(
    image: RangeImage,
    path: str | Path,
    *,
    title: str | None = None,
    classes: Sequence[str] = (),
    truth: TrueBoxes | None = None,
    detections: ScoredBoxes | None = None,
    azimuth_limits_rad: tuple[float, float] | None = None,
) -> None:
    """Plot the range of each round, and intensity and time lag of the first round.

    Columns run clockwise, in a full turn from azimuth +180 degrees. The highest beam is on top, and empty cells
    are grey. The range scale is logarithmic, because most cells are near. The time lag is omitted if all points
    are current.

    Truth and detections, one per object, have separate panels; both are in the frame of the points. Each box is
    outlined in round 1, in the colour of its class, around the cells whose points lie in it; boxes without such a
    cell are not visible.
    """
    right, left = np.degrees(azimuth_limits_rad or (-np.pi, np.pi)).round(6).tolist()
    step = 45 if left - right > 180 else 15
    azimuths = range(math.floor(left / step) * step, math.ceil(right / step) * step - 1, -step)
    features = np.asarray(image.features)
    rows, columns, _, rounds = features.shape
    lags = features[:, :, _LAG].any()
    shown = None if detections is None else one_per_object(detections)
    outlines = [(k, given) for k, given in (("truth", truth), ("detections", shown)) if given is not None]
    panels = [(_RANGE, 0, outline) for outline in outlines or [None]]
    panels += [(channel, 0, None) for channel in (_INTENSITY, _LAG) if channel == _INTENSITY or lags]
    panels += [(_RANGE, r, None) for r in range(1, rounds)]
    figure = new_figure(_WIDTH_IN, _PANEL_IN * len(panels) + 0.6)
    if title:
        set_title(figure, title, fontsize=12)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    ticks = np.unique(np.linspace(0, rows - 1, 5).round().astype(int))
    degrees = np.degrees(_row_inclinations(features))[ticks]
    for axis, (channel, r, outline) in zip(axes, panels, strict=True):
        name = _draw_channel(figure, axis, features, channel, r, (left, right))
        axis.set_ylabel("inclination", fontsize=9)
        axis.set(xlim=(left, right), ylim=(rows, 0))
        if outline is not None:
            kind, boxes = outline
            number = _outline(axis, features, boxes, classes, (left, right), full_turn=azimuth_limits_rad is None)
            name += f"; {kind}: {number} of {len(boxes[0])} boxes have a cell"
        axis.set_title(f"Round {r + 1}: {name}", fontsize=10, loc="left")
        axis.set_xticks(azimuths, [f"{v - 360 if v > 180 else v}°" for v in azimuths])
        axis.set_yticks(ticks + 0.5, [f"{round(v)}°" for v in degrees])
        axis.tick_params(labelsize=9)
    axes[-1].set_xlabel(f"azimuth (0° along +x, 90° along +y), {columns} columns clockwise", fontsize=9)
    save_png(figure, path)


def _draw_channel(
    figure: Any, axis: Any, features: np.ndarray, channel: int, r: int, span: tuple[float, float]
) -> str:
    import matplotlib as mpl
    from matplotlib.colors import LogNorm, Normalize

    filled = features[:, :, _EXISTENCE, r] > 0
    shades = {_RANGE: "viridis_r", _INTENSITY: "magma", _LAG: "cividis"}[channel]
    # All rounds of a channel share a colour scale. Quantiles keep outliers from dominating it.
    values = features[:, :, channel][features[:, :, _EXISTENCE] > 0]
    low, high = np.quantile(values, (0.01, 1 if channel == _LAG else 0.99)) if values.size else (1, 2)
    norm = LogNorm(max(low, 0.1), max(high, 1.1 * low, 0.2)) if channel == _RANGE else Normalize(0, high or 1)
    picture = axis.imshow(
        np.ma.masked_where(~filled, features[:, :, channel, r]),
        cmap=mpl.colormaps[shades].with_extremes(bad=EMPTY),
        norm=norm,
        aspect="auto",
        interpolation="nearest",
        extent=(*span, filled.shape[0], 0),
    )
    beyond = {_RANGE: "both", _INTENSITY: "max", _LAG: "neither"}[channel]
    bar = figure.colorbar(picture, ax=axis, pad=0.01, aspect=10, extend=beyond)
    bar.ax.tick_params(labelsize=9)
    if channel == _RANGE:
        bar.ax.minorticks_off()
        metres = [v for v in (1, 2, 5, 10, 20, 50, 100) if low <= v <= high]
        bar.set_ticks(metres, labels=[f"{v}" for v in metres])
        return f"range [m], {filled.sum():,} of {filled.size:,} cells filled ({filled.mean():.0%})"
    return "intensity (0-255)" if channel == _INTENSITY else "time lag [s]"


def _row_inclinations(features: np.ndarray) -> np.ndarray:
    """Inclination of each row in radians: the median of its points, interpolated for empty rows."""
    rows = np.arange(features.shape[0])
    filled = features[:, :, _EXISTENCE] > 0
    known = [i for i in rows if filled[i].any()]
    if not known:
        return np.zeros(len(rows))
    medians = [float(np.median(features[i, :, _INCLINATION][filled[i]])) for i in known]
    step = (medians[-1] - medians[0]) / max(known[-1] - known[0], 1)
    beyond = np.minimum(rows - known[0], 0) + np.maximum(rows - known[-1], 0)  # extrapolates by this many rows
    return np.interp(rows, known, medians) + beyond * step


def _outline(
    axis: Any,
    features: np.ndarray,
    given: tuple[np.ndarray, ...],
    classes: Sequence[str],
    span: tuple[float, float],
    *,
    full_turn: bool,
) -> int:
    """Draw rectangles around the first-round cells of each box; returns the number of boxes with cells.

    ``span`` are the azimuths of the picture's left and right side, degrees.
    """
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    columns = features.shape[1]
    first_round = features[..., 0].reshape(-1, features.shape[2])
    filled = np.flatnonzero(first_round[:, _EXISTENCE] > 0)
    boxes, labels, *scores = given
    boxes_cells = [filled[rows] for rows in points_in_boxes(first_round[filled, :3], boxes)]
    degrees, drawn = (span[0] - span[1]) / columns, []
    for index, cells in enumerate(boxes_cells):
        if not len(cells):
            continue
        rows_in, columns_in = np.divmod(cells, columns)
        top, bottom = rows_in.min(), rows_in.max() + 1
        spans = _spans(columns_in, columns) if full_turn else [(columns_in.min(), columns_in.max())]
        edges = [(span[0] - degrees * first, span[0] - degrees * (last + 1)) for first, last in spans]
        for left, right in edges:
            style = {"edgecolor": class_color(labels[index]), "linewidth": 1.4}
            around = axis.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, **style))
            around.set_path_effects([withStroke(linewidth=2.6, foreground="white")])
        left, right = edges[-1]
        place = np.array([left + right, top + bottom]) / 2, np.array([left - right, bottom - top]) / 2
        drawn.append((*place, int(labels[index]), float(scores[0][index]) if scores else None))
    width_pt, height_pt = 0.88 * 72 * _WIDTH_IN, 0.8 * 72 * _PANEL_IN
    write_labels(axis, drawn, classes, (degrees * columns / width_pt, features.shape[0] / height_pt))
    return len(drawn)


def _spans(columns_in: np.ndarray, columns: int) -> Iterator[tuple[int, int]]:
    """First and last column of a box's cells, as two spans if the box crosses azimuth 180 degrees."""
    left, right = columns_in[columns_in < columns // 2], columns_in[columns_in >= columns // 2]
    across = len(left) and len(right) and right.min() - left.max() > columns // 2
    for part in (left, right) if across else (columns_in,):
        yield int(part.min()), int(part.max())
