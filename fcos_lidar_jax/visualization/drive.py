"""Animation of a drive with the range image and the bird's-eye view of each keyframe."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, one_per_object
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CHANNELS
from fcos_lidar_jax.visualization.bev import bev_on, class_legend
from fcos_lidar_jax.visualization.evaluation_report import Example
from fcos_lidar_jax.visualization.figure import EMPTY, new_figure, save_png, set_title

_SIZE_IN = (8.3, 9.6)
_DPI = 90
_SCENE_S = 0.5  # duration of each scene
_COLORS = 96  # colours of the GIF; more colours increase its size but hardly its quality


def draw_drive(
    path: str | Path,
    scenes: Sequence[Example],
    *,
    sensor: Sensor,
    classes: Sequence[str],
    title: str,
    limit_m: float,
    report: Callable[[int], object],
) -> None:
    """Write an animated GIF, and one PNG file per scene beside it, ``NAME_00.png`` and so on.

    The top shows the range image, with the forward direction in the middle. Below is the bird's-eye view with
    detections and dashed truth, in a square with half the side ``limit_m``. ``title`` begins the title of each
    picture; ``report`` is called with the number of finished scenes.
    """
    from PIL import Image

    path = Path(path)
    files = [path.with_name(f"{path.stem}_{number:02d}.png") for number in range(len(scenes))]
    shown = []
    for scene in scenes:
        boxes, labels, scores = scene.detections
        kept = scores >= SHOWN_SCORE
        shown.append(one_per_object((boxes[kept], labels[kept], scores[kept])))
    present = {int(k) for scene, found in zip(scenes, shown, strict=True) for k in (*found[1], *scene.truth[1])}
    title = f"{title}: score {SHOWN_SCORE:g} and more, truth dashed"
    size = max(len(scene.points) for scene in scenes)  # one size, so that the projection is compiled once
    pictures = []
    for number, (scene, found, file) in enumerate(zip(scenes, shown, files, strict=True)):
        figure = new_figure(*_SIZE_IN)
        strip, view = figure.subplots(2, 1, height_ratios=(1, 7.4))
        _draw_ranges(strip, scene.points, size, sensor)
        bev_on(view, scene.points, limit_m=limit_m, classes=classes, detections=found, truth=scene.truth)
        class_legend(figure, sorted(present), classes, detections=True, truth=True)
        set_title(strip, f"{title}, {number * _SCENE_S:.1f} s", fontsize=11)
        save_png(figure, file, dpi=_DPI)
        with Image.open(file) as picture:
            pictures.append(picture.convert("RGB").quantize(_COLORS))
        report(number + 1)
    options: Any = {"save_all": True, "append_images": pictures[1:], "loop": 0, "duration": 1e3 * _SCENE_S}
    atomic_write(path, lambda out: pictures[0].save(out, "GIF", **options))


def _draw_ranges(axis: Any, points: np.ndarray, size: int, sensor: Sensor) -> None:
    """Plot the first round of the range image with the forward direction in the middle."""
    import matplotlib as mpl
    from matplotlib.colors import LogNorm

    padded = np.pad(points, ((0, size - len(points)), (0, 0)))
    image = project_points(padded, np.arange(size) < len(points), sensor, num_rounds=1)
    first_round = np.asarray(image.features)[..., 0]
    range_m, exists = (first_round[..., CHANNELS.index(name)] for name in ("range", "existence"))
    # Columns run clockwise from azimuth 180 degrees. The forward direction, +y, is at 90 degrees.
    ranges, left, right = np.ma.masked_where(exists == 0, range_m), -180.0, 180.0
    if sensor.azimuth_limits_rad is None:
        ranges = np.roll(ranges, sensor.num_columns // 4, axis=1)
    else:
        right, left = 90 - np.degrees(sensor.azimuth_limits_rad)
    picture = axis.imshow(
        ranges,
        cmap=mpl.colormaps["viridis_r"].with_extremes(bad=EMPTY),
        norm=LogNorm(2, sensor.limit_xy_m),
        aspect="auto",
        interpolation="nearest",
        extent=(left, right, sensor.num_rows, 0),
    )
    bar = axis.figure.colorbar(picture, ax=axis, pad=0.01, extend="both", ticks=[2, 5, 10, 20, 50], format="%g")
    bar.ax.minorticks_off()
    bar.set_label("range [m]", fontsize=9)
    names = {-180: "behind", -90: "left", 0: "ahead", 90: "right", 180: "behind"}
    ticks = [degrees for degrees in names if left <= degrees <= right]
    axis.set_xticks(ticks, [names[degrees] for degrees in ticks], fontsize=9)
    axis.set_yticks(())
    axis.set_ylabel(f"{sensor.num_rows} beams", fontsize=9)
