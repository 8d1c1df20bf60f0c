"""A drive as one HTML file that asks for nothing else: points, boxes and the way of the ego vehicle."""

import base64
import dataclasses
import gzip
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.sweeps import Sweep
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.visualization.figure import class_color

STEP_M = 0.02  # Points are rounded to multiples of it.
_LIMIT = 2**15 - 1  # int16: points up to 655 m away.


@dataclasses.dataclass(frozen=True)
class PageFrame:
    """A sweep with its boxes, as the page holds it."""

    name: str
    time_us: int | None  # None where it is not known.
    pose: list[float] | None  # 16 numbers, row by row, from the sensor to the world; likewise.
    num_points: int  # Finite ones within reach, each cell of the size STEP_M counted once.
    points: str  # See encode_points.
    boxes: list[list[float]]  # x, y, z, l, w, h, yaw, vx, vy
    labels: list[int]
    scores: list[float]
    ids: list[int] | None  # Over time, None where they are not known.


def page_frame(
    sweep: Sweep,
    boxes: np.ndarray,
    labels: np.ndarray,
    scores: np.ndarray,
    ids: np.ndarray | None = None,
    *,
    posed: bool = True,
) -> PageFrame:
    """A sweep and the boxes f32[m, 9] in its frame, encoded, so that a long drive fits into memory."""
    num_points, points = encode_points(sweep.points)
    return PageFrame(
        Path(sweep.name).name,
        sweep.time_us if posed else None,
        np.ravel(sweep.sensor_to_world).tolist() if posed else None,
        num_points,
        points,
        np.asarray(boxes).tolist(),
        np.asarray(labels).tolist(),
        np.asarray(scores).tolist(),
        None if ids is None else ids.tolist(),
    )


def encode_points(points: np.ndarray) -> tuple[int, str]:
    """Points in few bytes: rounded, each place once, sorted by x, compressed.

    The bytes are planes, one behind another: x as int16 differences, y and z as int16, the low bytes of each
    before its high bytes, then the intensity as uint8; compressed by gzip, written in base64.

    Args:
        points: f32[n, >= 4]: x, y, z in metres, intensity (0-255).

    Returns:
        how many points are left, and the text.

    >>> encode_points(np.array([[1, 2, 3, 9], [1, 2, 3.001, 9], [np.nan, 0, 0, 0]], np.float32))[0]
    1
    """
    near = (np.abs(points[:, :3]) < STEP_M * _LIMIT).all(axis=1)
    places = np.round(points[near, :3] / STEP_M).astype("<i2")
    places, first = np.unique(places, axis=0, return_index=True)  # sorted by x first
    places[:, 0] = np.diff(places[:, 0], prepend=places.dtype.type(0))
    planes = places.T.copy().view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    intensity = np.clip(np.nan_to_num(points[near, 3][first]), 0, 255).astype(np.uint8)
    data = gzip.compress(planes.tobytes() + intensity.tobytes(), 9, mtime=0)
    return len(places), base64.b64encode(data).decode()


def write_page(path: str | Path, frames: Sequence[PageFrame], *, classes: Sequence[str], title: str) -> None:
    """Write the page.

    Args:
        path: of the HTML file.
        frames: in the order of time.
        classes: names that the labels index.
        title: of the page.
    """
    content: dict[str, Any] = {"title": title, "step_m": STEP_M, "classes": list(classes)}
    content |= {"colors": [class_color(label) for label in range(len(classes))]}
    content |= {"frames": [dataclasses.asdict(frame) for frame in frames]}
    text = json.dumps(content).replace("<", "\\u003c")  # names may hold anything, even the end of a script
    template = files("fcos_lidar_jax.visualization").joinpath("page.html").read_text(encoding="utf-8")
    atomic_write(path, lambda file: file.write_text(template.replace("{{drive}}", text), encoding="utf-8"))
