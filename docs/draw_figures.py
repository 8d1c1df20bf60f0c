"""The figures of ``docs/paper.md``, from one simulated frame of nuScenes' sensor: ten sweeps, traffic in motion.

``python -m docs.draw_figures --out docs/figures``, half a minute on a CPU.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Rectangle

from experiments.script import run_script
from fcos_lidar_jax.assignment import assign, owners
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.iou import rotated_iou_3d
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.simulation.streets import CITY
from fcos_lidar_jax.types import CHANNELS
from fcos_lidar_jax.visualization.figure import EMPTY, LINE_COLORS, new_figure, save_png

_SEED = 4
_ROUNDS = 9
_WIDTH = 150  # Columns that are shown, with the object of the figures in their middle.
_RANGE, _EXISTENCE, _LAG = (CHANNELS.index(name) for name in ("range", "existence", "time_lag"))
_MODALITY = (0, 0, 0, 1, 1, 1, 2, 3, 4)  # of each channel type


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """Options of the script."""

    out: Path = Path("docs/figures")  # Folder for the pictures.


@dataclasses.dataclass(frozen=True)
class Scene:
    """A frame and the part of its range image that the figures show."""

    frame: Frame
    box: np.ndarray  # Of the object in the middle.
    columns: slice

    def project(self, points: np.ndarray, **options: Any) -> np.ndarray:
        """Features f32[h, w, 9, r]."""
        image = project_points(points, np.ones(len(points), bool), NUSCENES_HDL32E, **options)
        return np.asarray(image.features)


def main(args: Figures) -> None:
    """Draw all figures."""
    args.out.mkdir(parents=True, exist_ok=True)
    scene = _scene()
    drawn: dict[str, Callable[[Scene], Any]] = {
        "rounds": draw_rounds,
        "priority": draw_priority,
        "modalities": draw_modalities,
        "dynamic_k": draw_dynamic_k,
    }
    for name, draw in drawn.items():
        save_png(draw(scene), args.out / f"{name}.png", dpi=100)


def _scene() -> Scene:
    """Around the fastest of the cars that many points show, away from the ends of the image."""
    options: dict[str, Any] = {"num_objects": 60, "reach_m": 54.0, "streets": CITY, "reading": CloudReading(10)}
    frame = make_frame(_SEED, NUSCENES_HDL32E, fast_traffic=True, **options)
    column = (np.pi - np.arctan2(frame.boxes[:, 1], frame.boxes[:, 0])) / NUSCENES_HDL32E.column_rad
    inside = np.abs(column - NUSCENES_HDL32E.num_columns / 2) < NUSCENES_HDL32E.num_columns / 2 - _WIDTH
    shown = inside & (frame.labels == 0) & (frame.num_points >= 60)
    chosen = int(np.argmax(np.where(shown, np.hypot(*frame.boxes[:, 7:9].T), -1)))
    first = int(column[chosen]) - _WIDTH // 2
    return Scene(frame, frame.boxes[chosen], slice(first, first + _WIDTH))


def draw_rounds(scene: Scene) -> Any:
    """How many points are kept, and what the first, the second and the fifth round hold."""
    figure = new_figure(9, 6.4)
    curves, *panels = figure.subplots(4, 1, height_ratios=(2.1, 1, 1, 1))
    current = scene.frame.points[scene.frame.points[:, 4] == 0]
    for points, label, color in (
        (current, "one sweep", LINE_COLORS[0]),
        (scene.frame.points, "ten sweeps", LINE_COLORS[1]),
    ):
        features = scene.project(points, num_rounds=_ROUNDS)
        kept = features[:, :, _EXISTENCE].sum(axis=(0, 1)).cumsum() / len(points)
        rounds = np.arange(1, _ROUNDS + 1)
        curves.plot(rounds, 100 * kept, "o-", color=color, label=f"{label}, {len(points):,} points")
    curves.set(xlabel="rounds", ylabel="points kept [%]", ylim=(0, 105))
    curves.axvline(5, color="#999999", linestyle=":")
    curves.grid(color="#e5e5e5", linewidth=0.6)
    curves.legend(loc="lower right", frameon=False)
    for axis, index in zip(panels, (0, 1, 4), strict=True):
        filled = features[:, scene.columns, _EXISTENCE, index].mean()
        title = f"Round {index + 1}: range, {filled:.0%} of these cells filled"
        _show(figure, axis, features[:, scene.columns, :, index], _RANGE, title)
    return figure


def draw_priority(scene: Scene) -> Any:
    """The age of what the first round keeps, without and with priority: in the image, and around a moving car."""
    figure = new_figure(9, 6.6)
    grid = figure.add_gridspec(3, 2, height_ratios=(1, 1, 2.4))
    images = [figure.add_subplot(grid[i, :]) for i in range(2)]
    above = [figure.add_subplot(grid[2, i]) for i in range(2)]
    x, y, _, length, width, _, yaw = scene.box[:7]
    for image, axis, prioritized in zip(images, above, (False, True), strict=True):
        first = scene.project(scene.frame.points, num_rounds=1, prioritize_current=prioritized)[..., 0]
        filled = first[..., _EXISTENCE] > 0
        share = (first[filled][:, _LAG] == 0).mean()
        words = "With priority" if prioritized else "Without priority"
        title = f"{words}: {share:.0%} of the cells of round 1 show the current sweep"
        _show(figure, image, first[:, scene.columns], _LAG, title)
        cells = first[filled]
        axis.scatter(cells[:, 0], cells[:, 1], c=cells[:, _LAG], s=9, cmap="cividis", norm=Normalize(0, 0.45))
        turned = {"angle": np.degrees(yaw), "rotation_point": "center", "fill": False}
        box = Rectangle((x - length / 2, y - width / 2), length, width, edgecolor="#d62728", **turned)
        axis.add_patch(box)
        axis.set(xlim=(x - 8, x + 8), ylim=(y - 5, y + 5))
        axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        axis.set_title(f"{words}, from above: a car at {np.hypot(*scene.box[7:9]):.0f} m/s", fontsize=10)
    return figure


def draw_modalities(scene: Scene) -> Any:
    """The nine channel types side by side, and the cells that one output of the stem sees."""
    figure = new_figure(9, 5.6)
    grid = figure.add_gridspec(4, 3, height_ratios=(1, 1, 1, 1.7))
    first = scene.project(scene.frame.points, num_rounds=1)[:, scene.columns, :, 0]
    for channel, name in enumerate(CHANNELS):
        axis = figure.add_subplot(grid[channel // 3, channel % 3])
        _show(None, axis, first, channel, name.replace("_", " "))
        for side in axis.spines.values():
            side.set(color=LINE_COLORS[_MODALITY[channel]], linewidth=2.5)
        axis.set(xticks=[], yticks=[])
    axis = figure.add_subplot(grid[3, :])
    _show(None, axis, first, _RANGE, "Two 3x3 convolutions with dilation 1, 3 and 6: cells that an output sees")
    row = _middle_row(scene, first)
    for dilation, color in zip((6, 3, 1), ("#ff1f1f", "#ff9d00", "#ffffff"), strict=True):
        taps = np.arange(-2, 3) * dilation
        x, y = np.meshgrid(_WIDTH // 2 + taps + 0.5, row + taps + 0.5)
        axis.scatter(x, y, s=9, color=color, edgecolor="black", linewidth=0.4, label=f"dilation {dilation}")
    axis.set(xlim=(0, _WIDTH), ylim=(len(first), 0))
    axis.legend(loc="upper right", fontsize=8, framealpha=0.95)
    return figure


def draw_dynamic_k(scene: Scene) -> Any:
    """IoU of every candidate's box, the positives, and the sum that gives K: for poor and for good predictions."""
    figure = new_figure(9, 5.4)
    axes = figure.subplots(2, 2, width_ratios=(1.5, 1))
    first = scene.project(scene.frame.points, num_rounds=1)[..., 0]
    cells = first.reshape(-1, 9)
    exists = cells[:, _EXISTENCE] > 0
    owner = np.asarray(owners(cells[:, :3], exists, scene.box[None], np.ones(1, bool)))
    candidates = np.flatnonzero(owner == 0)
    rows, columns = np.divmod(candidates, first.shape[1])
    rng = np.random.default_rng(0)
    for (image, bars), error_m in zip(axes, (2.5, 0.3), strict=True):
        boxes = np.repeat(scene.box[None], len(candidates), axis=0)
        boxes[:, :3] += rng.normal(0, error_m, (len(candidates), 3)) * (1, 1, 0.3)
        iou = np.asarray(rotated_iou_3d(boxes, scene.box[None])).reshape(-1)
        targets = assign(jnp.zeros(len(iou), jnp.int32), jnp.zeros(len(iou)), jnp.asarray(iou), num_boxes=1)
        k, positive = int(targets.num_positive[0]), np.asarray(targets.positive)
        shown = np.full((np.ptp(rows) + 3, np.ptp(columns) + 3), np.nan)
        y, x = rows - rows.min() + 1, columns - columns.min() + 1
        shown[y, x] = iou
        shades = mpl.colormaps["viridis"].with_extremes(bad=EMPTY)
        picture = image.imshow(shown, cmap=shades, norm=Normalize(0, 1), aspect="auto", interpolation="nearest")
        figure.colorbar(picture, ax=image, pad=0.01, label="IoU")
        for cx, cy in zip(x[positive], y[positive], strict=True):
            image.add_patch(Rectangle((cx - 0.5, cy - 0.5), 1, 1, fill=False, edgecolor="#ff1f1f", linewidth=1.6))
        image.set(xticks=[], yticks=[])
        image.set_title(f"Centres {error_m} m off: {len(iou)} candidates, {k} positive", fontsize=10, loc="left")
        best = np.sort(iou)[::-1][:20]
        bars.bar(np.arange(1, len(best) + 1), best, color=LINE_COLORS[0])
        bars.set(ylim=(0, 1), xlabel="the 20 best candidates", ylabel="IoU")
        bars.set_title(f"sum {best.sum():.1f}, so K = {k}", fontsize=10, loc="left")
    return figure


def _middle_row(scene: Scene, first: np.ndarray) -> int:
    """Row of the object's middle."""
    inside = np.asarray(
        owners(first.reshape(-1, 9)[:, :3], first[..., 7].ravel() > 0, scene.box[None], np.ones(1, bool))
    )
    return int(np.median(np.flatnonzero(inside == 0) // first.shape[1]))


def _show(figure: Any, axis: Any, features: np.ndarray, channel: int, title: str) -> None:
    """One channel f32[h, w] of a round, empty cells grey; a colour bar where there is a figure for it."""
    values, filled = features[..., channel], features[..., _EXISTENCE] > 0
    norm = LogNorm(3, 54) if channel == _RANGE else Normalize(0, 0.45) if channel == _LAG else None
    shades = {_RANGE: "viridis_r", _LAG: "cividis"}.get(channel, "viridis")
    picture = axis.imshow(
        np.ma.masked_where(~filled, values),
        cmap=mpl.colormaps[shades].with_extremes(bad=EMPTY),
        norm=norm,
        aspect="auto",
        interpolation="nearest",
        extent=(0, values.shape[1], values.shape[0], 0),
    )
    axis.set_title(title, fontsize=10, loc="left")
    axis.set(xticks=[], ylabel="" if figure is None else "row")
    if figure is not None:
        bar = figure.colorbar(picture, ax=axis, pad=0.01, label="range [m]" if channel == _RANGE else "age [s]")
        if channel == _RANGE:
            bar.ax.minorticks_off()
            bar.set_ticks([5, 10, 20, 50], labels=["5", "10", "20", "50"])


if __name__ == "__main__":
    run_script(main, Figures, __doc__)
