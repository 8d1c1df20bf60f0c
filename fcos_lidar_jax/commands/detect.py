"""``fcos-lidar detect``: point files to boxes."""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from fcos_lidar_jax.commands.clouds import Cloud, expect_points, make_cloud
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.data.sweeps import read_sweeps
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training import Checkpoint, load_checkpoint
from fcos_lidar_jax.training.snapshots import find_checkpoint
from fcos_lidar_jax.types import CLASSES, Detections


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detect boxes in point files and write them as JSON.

    A box is [x, y, z, l, w, h, yaw, vx, vy]: centre, length along the heading, width, height in metres, yaw in
    radians counter-clockwise from +x, velocity in m/s, all in the frame of the points.
    """

    files: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE")]]
    """Point files, one cloud each: .pcd.bin, .bin, .npy, .npz or .pcd."""
    checkpoint: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Trained detector: a checkpoint, a run, of which the best is taken, or `quickstart`, which is shipped."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Where the JSON goes."""
    sweeps: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """Instead of files: a list of sweeps to fuse, [{"file", "timestamp_us", "sensor_to_world": 4x4}], the first
    is the current one."""
    min_score: float = 0.0
    """Leave out boxes below this score."""
    remove_close: Literal["all", "sweeps", "none"] | None = None
    """Drop points within a metre of the sensor in x and y: of all sweeps, of the older ones, or none. Default:
    as the detector was trained."""
    pictures: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also draw every cloud with its boxes, from above."""
    columns: int | None = None
    """Values a point in a raw file of another layout: 3, 4, 5 (the fifth is the time lag) or 6."""
    dtype: Literal["float16", "float32", "float64"] | None = None
    """Number type of a raw file of another layout."""


def run(args: Detect) -> None:
    """Do it."""
    if bool(args.files) == (args.sweeps is not None):
        raise ValueError("detect: expected point files or --sweeps, one of the two")
    checkpoint = load_checkpoint(find_checkpoint(args.checkpoint))
    config, sensor = checkpoint.config, checkpoint.sensor
    detector = build_detector(config, sensor)
    detect = jax.jit(make_detect(detector, config, sensor))
    results: list[dict[str, Any]] = []
    names = args.files or (args.sweeps,)
    began = time.monotonic()
    for number, file in enumerate(names, start=1):
        assert file is not None
        cloud = _read(args, file, checkpoint)
        found = jax.tree.map(np.asarray, detect(checkpoint.variables, cloud.points, cloud.valid))
        expect_points(file, cloud, int(found.num_dropped), sensor)
        boxes = as_records(found, min_score=args.min_score)
        results.append(
            {
                "file": str(file),
                "num_points": cloud.num_points,
                "num_dropped": int(found.num_dropped) + cloud.num_close,
                "num_close": cloud.num_close,
                "boxes": boxes,
            }
        )
        if args.pictures is not None:
            _draw(
                args.pictures / f"{number:04d}_{file.name}.png",
                cloud,
                found,
                args.min_score,
                sensor.limit_xy_m,
            )
        _progress(number, len(names), file, len(boxes), began)
    record = {"files": results}
    write_beside(args.out, lambda path: path.write_text(json.dumps(record, indent=1), encoding="utf-8"))


def _read(args: Detect, file: Path, checkpoint: Checkpoint) -> Cloud:
    config, sensor = checkpoint.config, checkpoint.sensor
    remove, close_m = args.remove_close or config.projection.remove_close, config.projection.close_m
    if args.sweeps is not None:
        # The sweeps' close points are dropped in their own frames, before the poses are applied.
        points, num_close = read_sweeps(file, sensor, remove_close=remove, close_m=close_m)
        cloud = make_cloud(points, sensor, size=config.max_points, remove="none")
        return dataclasses.replace(cloud, num_points=len(points) + num_close, num_close=num_close)
    points = read_points(file, sensor, columns=args.columns, dtype=args.dtype)
    return make_cloud(points, sensor, size=config.max_points, remove=remove, close_m=close_m)


def as_records(found: Detections, *, min_score: float = 0.0) -> list[dict[str, Any]]:
    """Detections of one cloud as JSON objects, best first.

    Args:
        found: NumPy arrays.
        min_score: leave out what is below.
    """
    return [
        {"label": CLASSES[label], "score": float(score), "box": [float(v) for v in box]}
        for box, label, score in zip(*confident(found, min_score), strict=True)
    ]


def confident(found: Detections, min_score: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes, labels and scores of the detections of one cloud that reach a score.

    Args:
        found: of one cloud.
        min_score: leave out what is below.
    """
    kept = np.asarray(found.valid) & (np.asarray(found.scores) >= min_score)
    return np.asarray(found.boxes)[kept], np.asarray(found.labels)[kept], np.asarray(found.scores)[kept]


def _draw(path: Path, cloud: Cloud, found: Detections, min_score: float, limit_m: float) -> None:
    from fcos_lidar_jax.visualization.bev import draw_bev

    least = max(min_score, 0.1)
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_bev(
        cloud.points[cloud.valid],
        path,
        detections=confident(found, least),
        limit_m=limit_m,
        title=f"{path.stem}: boxes of score {least:g} and more",
    )


def _progress(number: int, total: int, file: Path, num_boxes: int, began: float) -> None:
    rate = number / (time.monotonic() - began)
    left = f"{rate:.2f} files/s, {(total - number) / rate:.0f} s left"
    print(f"{number}/{total}  {file}: {num_boxes} boxes  {left}", file=sys.stderr, flush=True)
