"""Matplotlib figures without a display or global state, and the colours of all figures."""

import colorsys
from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import atomic_write

LINE_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""The colours of Okabe and Ito, which colour-blind readers can distinguish."""
EMPTY = "#d9d9d9"  # colour of empty cells
_CLASS_COLORS = (
    *("#1f77b4", "#d62728", "#9467bd", "#8c564b", "#e6a000"),
    *("#e377c2", "#17becf", "#2ca02c", "#ff6f00", "#5b5b5b"),
)
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


def set_title(place: Any, title: str, **style: Any) -> None:
    """Set the title of a figure or an axis verbatim: no math after ``$``, and any file name is valid."""
    write = place.suptitle if hasattr(place, "suptitle") else place.set_title
    write(title.encode("utf-8", "replace").decode(), **style).set_parse_math(False)


def save_png(figure: Any, path: str | Path, *, dpi: int = 110) -> None:
    """Write a figure as a PNG file atomically."""
    atomic_write(path, lambda file: figure.savefig(file, dpi=dpi, format="png"))
