"""Recording of a drive for the rerun viewer (extra ``viz``)."""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.records import ScoredBoxes, TrueBoxes
from fcos_lidar_jax.files import atomic_path
from fcos_lidar_jax.visualization.figure import class_color

_HIGH_M = 4.0  # height above ground at the end of the colour scale


@contextlib.contextmanager
def rerun_recording(
    path: Path, classes: Sequence[str], *, min_score: float = 0.0
) -> Iterator[Callable[..., None]]:
    """Yield a function that records frames, with the arguments of :func:`~.page.page_frame`.

    Frames are written immediately. The file appears when the context ends without an error. Boxes below
    ``min_score`` are not recorded, because the viewer cannot hide them. Positions are relative to the first pose,
    because the viewer's float32 would round world coordinates to decimetres.
    """
    import rerun as rr  # pyright: ignore[reportMissingImports]

    with atomic_path(path) as temporary:
        recording = rr.RecordingStream("fcos_lidar_jax")
        recording.save(temporary)
        with recording:
            yield functools.partial(_record, recording, itertools.count(), [], classes, min_score)
        recording.disconnect()


def _record(
    recording: Any,
    number: Iterator[int],
    origin: list[np.ndarray],
    classes: Sequence[str],
    min_score: float,
    points: np.ndarray,
    found: ScoredBoxes,
    *,
    name: str,
    time_us: int | None = None,
    pose: np.ndarray | None = None,
    ids: np.ndarray | None = None,
    truth: TrueBoxes | None = None,
) -> None:
    """Record points coloured by height, boxes with class, score and identity, and truth, in the sensor's frame."""
    import matplotlib as mpl
    import rerun as rr  # pyright: ignore[reportMissingImports]

    recording.set_time("frame", sequence=next(number))
    if time_us is not None:
        recording.set_time("time", timestamp=np.datetime64(time_us, "us"))
    if pose is not None:
        origin[:] = origin or [pose[:3, 3]]
        recording.log("sensor", rr.Transform3D(translation=pose[:3, 3] - origin[0], mat3x3=pose[:3, :3]))
    points = points[np.isfinite(points[:, :3]).all(axis=1)]
    height = points[:, 2] - (np.quantile(points[:, 2], 0.1) if len(points) else 0)
    colors = mpl.colormaps["viridis"](height / _HIGH_M, bytes=True)
    recording.log("sensor/points", rr.Points3D(points[:, :3], colors=colors))
    kept = found[2] >= min_score
    boxes, labels, scores = (array[kept] for array in found)
    texts = [f"{classes[k]} {score:.2f}" for k, score in zip(labels, scores, strict=True)]
    if ids is not None:
        texts = [f"{text} #{i}" for text, i in zip(texts, ids[kept], strict=True)]
    recording.log("sensor/boxes", _shapes(boxes, labels, texts))
    if truth is not None:
        recording.log("sensor/truth", _shapes(*truth, [f"{classes[k]}, truth" for k in truth[1]]))
    recording.log("name", rr.TextLog(name))


def _shapes(boxes: np.ndarray, labels: np.ndarray, texts: list[str]) -> Any:
    import rerun as rr  # pyright: ignore[reportMissingImports]

    half, zero = boxes[:, 6] / 2, np.zeros(len(boxes))
    return rr.Boxes3D(
        centers=boxes[:, :3],
        half_sizes=boxes[:, 3:6] / 2,
        quaternions=np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1),
        labels=texts,
        colors=[int(class_color(k)[1:] + "ff", 16) for k in labels],
    )
