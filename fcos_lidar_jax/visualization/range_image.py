"""Pictures of multi-round range images."""

from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.types import CHANNELS, RangeImage
from fcos_lidar_jax.visualization.figure import new_figure, save_png
from fcos_lidar_jax.visualization.palette import EMPTY

_RANGE, _INTENSITY, _EXISTENCE, _LAG = (CHANNELS.index(c) for c in ("range", "intensity", "existence", "time_lag"))


def draw_range_image(image: RangeImage, path: str | Path, *, title: str | None = None) -> None:
    """Draw the range of every round, and intensity and time lag of the first.

    Columns run clockwise from azimuth +180 degrees; row 0 is the highest beam; empty cells are grey.

    Args:
        image: of one sample.
        path: PNG to write.
        title: above the picture.
    """
    import matplotlib as mpl

    features = np.asarray(image.features)
    rows, columns, _, rounds = features.shape
    panels = [(f"range [m], round {r + 1}", _RANGE, r, "viridis_r") for r in range(rounds)]
    panels.append(("intensity, round 1", _INTENSITY, 0, "magma"))
    if features[:, :, _LAG].any():
        panels.append(("time lag [s], round 1", _LAG, 0, "cividis"))
    figure = new_figure(13, 1.55 * len(panels) + 0.5)
    if title:
        figure.suptitle(title, fontsize=11)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    top_range = float(np.quantile(features[:, :, _RANGE][features[:, :, _EXISTENCE] > 0], 0.98, method="nearest"))
    for axis, (name, channel, r, colors) in zip(axes, panels, strict=True):
        filled = features[:, :, _EXISTENCE, r] > 0
        values = np.ma.masked_where(~filled, features[:, :, channel, r])
        shades = mpl.colormaps[colors].with_extremes(bad=EMPTY)
        limits: dict[str, Any] = {"vmin": 0, "vmax": top_range} if channel == _RANGE else {"vmin": 0}
        picture = axis.imshow(
            values, cmap=shades, aspect="auto", interpolation="nearest", extent=(180, -180, rows, 0), **limits
        )
        axis.set_title(f"{name}: {filled.sum():,} of {rows * columns:,} cells filled", fontsize=9, loc="left")
        axis.set_ylabel("beam", fontsize=8)
        axis.set_yticks([0, rows // 2, rows])
        axis.set_xticks(range(180, -181, -45))
        axis.tick_params(labelsize=8)
        figure.colorbar(picture, ax=axis, pad=0.01, aspect=10).ax.tick_params(labelsize=8)
    axes[-1].set_xlabel("azimuth [degrees], columns run clockwise", fontsize=9)
    save_png(figure, path)
