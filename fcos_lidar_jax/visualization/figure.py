"""Matplotlib without a screen and without global state."""

from pathlib import Path
from typing import Any

from fcos_lidar_jax.files import write_beside


def new_figure(width_in: float, height_in: float) -> Any:
    """An empty figure, drawn off screen."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def save_png(figure: Any, path: str | Path, *, dpi: int = 110) -> None:
    """Write a figure as PNG, whole or not at all."""
    write_beside(path, lambda file: figure.savefig(file, dpi=dpi, format="png"))
