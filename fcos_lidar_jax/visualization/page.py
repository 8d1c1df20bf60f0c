"""Self-contained HTML page of frames with points, boxes, truth and the path of the ego vehicle."""

import base64
import dataclasses
import gzip
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.point_files import MAX_TIME_LAG_S
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, ScoredBoxes, TrueBoxes, rows_of_objects
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.visualization.figure import class_color

STEP_M = 0.02  # resolution of the points
_LIMIT = 2**15 - 1  # int16, for points up to 655 m


@dataclasses.dataclass(frozen=True)
class PageFrame:
    """A cloud with its boxes, encoded for the page by :func:`page_frame`. Optional fields are None if unknown."""

    name: str
    time_us: int | None
    pose: list[float] | None  # 16 numbers in row-major order, from the sensor to the world
    num_points: int  # finite points within range, one per sweep and cell of size STEP_M
    max_lag_s: float  # largest time lag of the points; 0 for a single sweep
    points: str  # see encode_points
    boxes: list[list[float | None]]  # x, y, z, l, w, h, yaw, vx, vy; None for non-finite numbers
    labels: list[int]
    scores: list[float]
    ids: list[int] | None  # identities over time
    truth: list[list[float | None]] | None  # same format as boxes
    truth_labels: list[int] | None


def page_frame(
    points: np.ndarray,
    found: ScoredBoxes,
    *,
    name: str,
    time_us: int | None = None,
    pose: np.ndarray | None = None,
    ids: np.ndarray | None = None,
    truth: TrueBoxes | None = None,
) -> PageFrame:
    """Encode a cloud and its boxes, one per object, compactly, so that many frames fit into memory.

    Args:
        points: see :func:`encode_points`; all boxes are in their frame.
        time_us, pose: time, and pose f64[4, 4] in the world; only for frames of the same drive.
        ids: i32[m], identities over time.
    """
    rows = rows_of_objects(found)
    boxes, labels, scores = (np.asarray(part)[rows] for part in found)
    return PageFrame(
        name,
        time_us,
        None if pose is None else np.ravel(pose).tolist(),
        *encode_points(points),
        _numbers(boxes),
        labels.tolist(),
        _numbers(scores),
        None if ids is None else ids[rows].tolist(),
        None if truth is None else _numbers(truth[0]),
        None if truth is None else np.asarray(truth[1]).tolist(),
    )


def _numbers(values: np.ndarray) -> list[Any]:
    """Nested lists with None for non-finite numbers, which JSON excludes."""
    plain = np.array(values, object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def encode_points(points: np.ndarray) -> tuple[int, float, str]:
    """Encode points compactly: rounded, without duplicates within a sweep, sorted by time lag and x, compressed.

    The data consist of consecutive planes: x as int16 differences, y and z as int16, each with all low bytes
    before all high bytes, then intensity and time lag as uint8, with 255 for the largest lag. The planes are
    compressed with gzip and encoded in base64. Returns the number of remaining points, their largest time lag in
    seconds, and the text.

    Args:
        points: f32[n, >= 4]: x, y, z in metres, intensity (0-255), optional time lag in seconds.
    """
    points = points[(np.abs(points[:, :3]) < STEP_M * _LIMIT).all(axis=1)]
    lags = points[:, 4] if points.shape[1] > 4 else np.zeros(len(points))
    lags = np.clip(np.nan_to_num(lags), 0, MAX_TIME_LAG_S)
    longest = float(lags.max(initial=0))
    age = np.round(lags * (255 / longest if longest else 0)).astype(np.int64)
    # Sorting one integer per point is many times faster than sorting rows.
    x, y, z = np.round(points[:, :3].T / STEP_M).astype(np.int64) - np.iinfo(np.int16).min
    _, first = np.unique(age << 48 | x << 32 | y << 16 | z, return_index=True)
    places = np.stack([np.diff(x[first], prepend=2**15), y[first] - 2**15, z[first] - 2**15]).astype("<i2")
    planes = places.view(np.uint8).reshape(3, -1, 2).transpose(0, 2, 1)
    intensity = np.clip(np.nan_to_num(points[first, 3]), 0, 255).astype(np.uint8)
    data = planes.tobytes() + intensity.tobytes() + age[first].astype(np.uint8).tobytes()
    return len(first), longest, base64.b64encode(gzip.compress(data, 6, mtime=0)).decode()


def write_page(
    path: str | Path,
    frames: Sequence[PageFrame],
    sensor: Sensor | None = None,
    *,
    classes: Sequence[str],
    title: str,
    min_score: float = SHOWN_SCORE,
    ego: bool = True,
) -> None:
    """Write the HTML page.

    ``sensor`` gives the heading of the ego vehicle in frames without poses, by default along y; ``ego`` is False
    for boxes in a global frame, where no heading is known. ``min_score`` is the initial threshold of the visible
    boxes.

    >>> import tempfile
    >>> found = np.array([[0, 9, 0, 4, 2, 2, 0, 0, 0]]), np.array([0]), np.array([0.9])
    >>> file = Path(tempfile.mkdtemp()) / "page.html"
    >>> frame = page_frame(np.array([[0, 8.0, 0, 50]]), found, name="street")
    >>> write_page(file, [frame], classes=["car"], title="one car")
    >>> "<title>" in file.read_text(encoding="utf-8")
    True
    """
    content: dict[str, Any] = {"title": title, "step_m": STEP_M, "score": min_score, "classes": list(classes)}
    content |= {"colors": [*map(class_color, range(len(classes)))], "forward_rad": sensor and sensor.forward_rad}
    content["ego"] = ego
    content |= {"frames": [dataclasses.asdict(frame) for frame in frames]}
    # Names may contain anything, even "</script>".
    text = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    template = files("fcos_lidar_jax.visualization").joinpath("page.html").read_text(encoding="utf-8")
    atomic_write(path, template.replace("{{drive}}", text))
