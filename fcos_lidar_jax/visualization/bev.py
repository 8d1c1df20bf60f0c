"""Bird's-eye views: points, detections, truth."""

from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.types import CLASSES
from fcos_lidar_jax.visualization.figure import new_figure, save_png
from fcos_lidar_jax.visualization.palette import CLASS_COLORS


def draw_bev(
    points: np.ndarray,
    path: str | Path,
    *,
    limit_m: float,
    detections: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    truth: tuple[np.ndarray, np.ndarray] | None = None,
    title: str | None = None,
) -> None:
    """Draw a cloud from above, x right and y forward.

    Detections are solid in their class's colour with the score, truth is dashed black; a line from the centre
    to the front shows the heading.

    Args:
        points: f32[n, >= 3], metres.
        path: PNG to write.
        limit_m: half the side of the square that is shown.
        detections: boxes f32[d, 9], labels i32[d], scores f32[d].
        truth: boxes f32[m, 9], labels i32[m].
        title: above the picture.
    """
    figure = new_figure(9, 9)
    axis = figure.add_subplot()
    shown = np.isfinite(points[:, :3]).all(axis=1)
    cloud = points[shown]
    heights = np.clip(cloud[:, 2], -2.5, 2.5)
    dot = float(np.clip(3e4 / max(len(cloud), 1), 0.8, 7))  # sparse clouds get larger dots
    axis.scatter(
        cloud[:, 0], cloud[:, 1], c=heights, s=dot, cmap="Greys_r", vmin=-4, vmax=6, linewidths=0, rasterized=True
    )
    axis.plot(0, 0, marker="+", color="black", markersize=8)
    if truth is not None:
        for box in truth[0]:
            _outline(axis, box, color="black", linewidth=1.1, linestyle=(0, (3, 2)))
    present: list[int] = []
    if detections is not None:
        for box, label, score in zip(*detections, strict=True):
            color = CLASS_COLORS[label]
            _outline(axis, box, color=color, linewidth=1.6)
            if max(abs(box[0]), abs(box[1])) < limit_m:
                reach = np.hypot(box[3], box[4]) / 2
                axis.annotate(
                    f"{score:.2f}",
                    (box[0] + 0.6 * reach, box[1] + 0.6 * reach),
                    color=color,
                    fontsize=7,
                    clip_on=True,
                )
        present = sorted({int(label) for label in detections[1]})
    _legend(axis, present, truth is not None)
    axis.set_xlim(-limit_m, limit_m)
    axis.set_ylim(-limit_m, limit_m)
    axis.set_aspect("equal")
    axis.set_xlabel("x [m], right")
    axis.set_ylabel("y [m], forward")
    axis.grid(color="#eeeeee", linewidth=0.6)
    axis.set_axisbelow(True)
    if title:
        axis.set_title(title, fontsize=11)
    save_png(figure, path)


def _outline(axis: Any, box: np.ndarray, **style: Any) -> None:
    x, y, l, w, yaw = (float(box[i]) for i in (0, 1, 3, 4, 6))
    cos, sin = np.cos(yaw), np.sin(yaw)
    along = np.array([1, 1, -1, -1, 1]) * l / 2
    across = np.array([1, -1, -1, 1, 1]) * w / 2
    axis.plot(x + cos * along - sin * across, y + sin * along + cos * across, **style)
    axis.plot([x, x + cos * l / 2], [y, y + sin * l / 2], **{**style, "linewidth": 0.8})


def _legend(axis: Any, present: list[int], with_truth: bool) -> None:
    from matplotlib.lines import Line2D

    entries = [Line2D([], [], color=CLASS_COLORS[k], label=CLASSES[k].replace("_", " ")) for k in present]
    if with_truth:
        entries.append(Line2D([], [], color="black", linestyle=(0, (3, 2)), label="truth"))
    if entries:
        axis.legend(handles=entries, loc="upper right", fontsize=8, framealpha=0.9)
