"""Boxes in camera images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fcos_lidar_jax.evaluation.records import ScoredBoxes, TrueBoxes, one_per_object
from fcos_lidar_jax.files import refusing
from fcos_lidar_jax.visualization.bev import corners_from_above
from fcos_lidar_jax.visualization.figure import class_color, new_figure, save_png, write_labels

_WIDTH_IN = 12.0
_NEAR_M = 0.1  # lines are cut at this depth, because what is behind the camera has no place in the image
_EDGES = [(k, (k + 1) % 4) for k in range(4)]
_EDGES += [(k + 4, m + 4) for k, m in _EDGES] + [(k, k + 4) for k in range(4)]


def draw_camera(
    image: Path,
    path: str | Path,
    to_image: np.ndarray,
    *,
    classes: Sequence[str],
    detections: ScoredBoxes,
    truth: TrueBoxes,
) -> None:
    """Draw boxes in a camera image: detections with class and score in the colour of their class, truth dashed.

    Detections are drawn one per object. ``to_image`` f64[3, 4] leads from the frame of the boxes, metres, to
    homogeneous pixels.
    """
    from PIL import Image

    unreadable = OSError, ValueError, SyntaxError, Image.DecompressionBombError
    with refusing(f"{image}: expected a PNG or JPEG image", *unreadable), Image.open(image) as opened:
        pixels = np.asarray(opened.convert("RGB"))
    height, width = pixels.shape[:2]
    figure = new_figure(_WIDTH_IN, _WIDTH_IN * height / width)
    figure.set_layout_engine("none")  # the image fills the figure
    axis = figure.add_axes((0, 0, 1, 1))
    axis.imshow(pixels, aspect="auto")
    axis.set_axis_off()
    axis.set(xlim=(0, width), ylim=(height, 0))
    for box, label in zip(*truth, strict=True):
        axis.plot(*_edges(box, to_image).T, color=class_color(label), linewidth=1.0, linestyle="--")
    labels = []
    for box, label, score in zip(*one_per_object(detections), strict=True):
        edges = _edges(box, to_image)
        axis.plot(*edges.T, color=class_color(label), linewidth=1.6)
        low, high = np.clip([edges.min((0, 1)), edges.max((0, 1))], 0, (width, height)) if len(edges) else (0, 0)
        if np.all(high > low):
            labels.append(((low + high) / 2, (high - low) / 2, int(label), float(score)))
    point = width / (72 * _WIDTH_IN)
    write_labels(axis, labels, classes, (point, point))
    save_png(figure, path)


def _edges(box: np.ndarray, to_image: np.ndarray) -> np.ndarray:
    """Pixels of the ends of a box's visible edges, f64[e, 2, 2]."""
    xy, z, reach = corners_from_above(box)[:, :4], float(box[2]), float(box[5]) / 2
    corners = np.concatenate(
        [np.vstack([xy, np.full(4, z + side), np.ones(4)]) for side in (-reach, reach)], axis=1
    )
    places, edges = (to_image @ corners).T, []
    for ends in ([places[a], places[b]] for a, b in _EDGES):
        far, near = sorted(ends, key=lambda place: -place[2])
        if far[2] > _NEAR_M:
            if near[2] < _NEAR_M:
                near = far + (near - far) * (far[2] - _NEAR_M) / (far[2] - near[2])
            edges.append([far[:2] / far[2], near[:2] / near[2]])
    return np.array(edges).reshape(-1, 2, 2)
