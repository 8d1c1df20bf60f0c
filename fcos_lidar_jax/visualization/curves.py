"""Curves over steps."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fcos_lidar_jax.visualization.figure import new_figure, save_png


def draw_curves(
    path: str | Path,
    series: Mapping[str, Sequence[tuple[float, float]]],
    *,
    x_label: str,
    y_label: str,
    title: str,
    log_y: bool = False,
) -> None:
    """Draw named series of (x, y) into one PNG.

    Args:
        path: PNG to write.
        series: name -> points.
        x_label: below the abscissa.
        y_label: beside the ordinate.
        title: above the picture.
        log_y: logarithmic ordinate.
    """
    figure = new_figure(8, 4.5)
    axis = figure.add_subplot()
    for name, points in series.items():
        xs, ys = zip(*points, strict=True) if points else ((), ())
        axis.plot(xs, ys, label=name.replace("_", " "), linewidth=1.3, marker="o" if len(points) < 12 else None)
    if log_y:
        axis.set_yscale("log")
    axis.set_xlabel(x_label)
    axis.set_ylabel(y_label)
    axis.set_title(title, fontsize=11)
    axis.grid(color="#e5e5e5", linewidth=0.6)
    axis.legend(fontsize=8)
    save_png(figure, path)
