"""Matplotlib figures without a display or global state, their colours, and curves over steps."""

import colorsys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.files import atomic_write

LINE_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""The colours of Okabe and Ito, which colour-blind readers can distinguish."""
EMPTY = "#d9d9d9"  # colour of empty cells
_CLASS_COLORS = (
    *("#1f77b4", "#d62728", "#9467bd", "#8c564b", "#e6a000"),
    *("#e377c2", "#17becf", "#2ca02c", "#ff6f00", "#5b5b5b"),
)
_LABEL_POINTS = 7.0
_BEST = 10  # boxes whose labels may cover other boxes
_FEW = 40  # curves up to this length get markers, without which a single point is invisible
_GOLDEN = 0.6180339887  # hue step, the golden ratio, for which hues never repeat


def class_color(label: int) -> str:
    """Colour of a class, for any number of classes. The first ten colours are the most distinct.

    >>> class_color(0), class_color(10)
    ('#1f77b4', '#b83d91')
    """
    if label < len(_CLASS_COLORS):
        return _CLASS_COLORS[label]
    turn = label - len(_CLASS_COLORS)
    rgb = colorsys.hsv_to_rgb((0.885 + turn * _GOLDEN) % 1, 0.67, (0.72, 0.5, 0.88)[turn % 3])
    return "#" + "".join(f"{round(255 * part):02x}" for part in rgb)


def new_figure(width_in: float, height_in: float) -> Any:
    """Create an empty figure that needs no display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def new_axis(width_in: float, height_in: float) -> tuple[Any, Any]:
    """Create a figure with one axis for curves, with a grid and without top and right frame."""
    figure = new_figure(width_in, height_in)
    axis = figure.add_subplot()
    axis.grid(color="#e5e5e5", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    return figure, axis


def set_title(place: Any, title: str, *, fontsize: float, **style: Any) -> None:
    """Set the title of a figure or an axis, in as many lines as it needs to fit into the figure.

    The title is written verbatim: no math after ``$``, and any file name is valid.
    """
    write = place.suptitle if hasattr(place, "suptitle") else place.set_title
    width = 0.85 * 72 * place.get_figure(root=True).get_figwidth()
    title = title.encode("utf-8", "replace").decode()
    wrapped = (textwrap.wrap(title, n, break_on_hyphens=False) for n in range(len(title), 0, -1))
    lines = next((ls for ls in wrapped if all(_text_width(line, fontsize) <= width for line in ls)), [title])
    write("\n".join(lines), fontsize=fontsize, **style).set_parse_math(False)


def write_labels(
    axis: Any,
    boxes: Iterable[tuple[np.ndarray, np.ndarray, int, float | None]],
    classes: Sequence[str],
    point: tuple[float, float],
) -> None:
    """Write class and score beside boxes where there is room, else the score, best first; without room nothing.

    Labels do not cover each other. Only those of the best ten may cover other boxes.

    Args:
        boxes: centre and half the size in units of the axis, f64[2], label, and score, None for the truth.
        point: width and height of a typographic point in units of the axis.
    """
    from matplotlib.patheffects import withStroke

    low, high = np.sort([axis.get_xlim(), axis.get_ylim()]).T
    ranked = sorted(boxes, key=lambda box: -(box[3] or 0))
    covered = np.array([box[:2] for box in ranked], np.float64).reshape(-1, 2, 2)  # of the boxes
    placed = np.zeros((0, 2, 2))  # of the labels

    def is_free(place: np.ndarray, half: np.ndarray, taken: np.ndarray) -> bool:
        return bool((np.abs(place - taken[:, 0]) > half + taken[:, 1]).any(axis=1).all())

    for rank, (centre, reach, label, score) in enumerate(ranked):
        name, number = classes[label].replace("_", " "), "" if score is None else f"{score:.2f}"
        others = np.delete(covered, rank, axis=0)
        for text in filter(None, (f"{name} {number}".strip(), number)):
            half = np.array([_text_width(text, _LABEL_POINTS) / 2 + 1.5, 0.7 * _LABEL_POINTS]) * point
            beside = [centre + (reach + half) * side for side in ((1, 0), (-1, 0), (0, 1), (0, -1))]
            inside = [p for p in beside if (p - half > low).all() and (p + half < high).all()]
            free = [p for p in inside if is_free(p, half, placed)]
            if chosen := [p for p in free if is_free(p, half, others)] or (free if rank < _BEST else []):
                placed = np.concatenate([placed, [[chosen[0], half]]])
                style = {"fontsize": _LABEL_POINTS, "color": class_color(label), "zorder": 6}
                written = axis.text(*chosen[0], text, ha="center", va="center", parse_math=False, **style)
                written.set_path_effects([withStroke(linewidth=2, foreground="white")])
                break


def _text_width(text: str, fontsize: float) -> float:
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=fontsize)
    return text_to_path.get_text_width_height_descent(text, font, ismath=False)[0]


def save_png(figure: Any, path: str | Path, *, dpi: int = 110) -> None:
    """Write a figure as a PNG file atomically."""
    atomic_write(path, lambda file: figure.savefig(file, dpi=dpi, format="png"))


def draw_curves(
    path: str | Path,
    series: Mapping[str, Sequence[tuple[float, float]]],
    *,
    x_label: str,
    y_label: str,
    title: str,
    log_y: bool = False,
) -> None:
    """Plot named series of (x, y) in one PNG file.

    Non-finite points leave a gap, as do non-positive points on a logarithmic y axis.
    """
    figure, axis = new_axis(8, 4.5)
    for i, (name, points) in enumerate(series.items()):
        # When the colours repeat, lines are dashed.
        axis.plot(
            [x for x, _ in points],
            [y for _, y in points],
            label=name.replace("_", " "),
            color=LINE_COLORS[i % len(LINE_COLORS)],
            linestyle="-" if i < len(LINE_COLORS) else "--",
            linewidth=1.3,
            marker="o" if len(points) <= _FEW else None,
            markersize=3.5,
        )
    if log_y:
        axis.set_yscale("log", nonpositive="mask")
    axis.set(xlabel=x_label, ylabel=y_label)
    axis.set_title(title, fontsize=11)
    if series:
        axis.legend(fontsize=9, frameon=False)
    save_png(figure, path)
