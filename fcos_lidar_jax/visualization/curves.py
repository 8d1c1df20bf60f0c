"""Curves over steps."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fcos_lidar_jax.visualization.figure import LINE_COLORS, new_axis, save_png

_FEW = 40  # series up to this length get markers, without which a single point is invisible


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

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "loss.png"
    >>> draw_curves(file, {"loss": [(1, 0.9), (2, 0.4)]}, x_label="step", y_label="loss", title="training")
    >>> file.exists()
    True
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
