"""``fcos-lidar detect``: point files to boxes."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from fcos_lidar_jax.data.clouds import CloudFiles, find_clouds
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.inference.cloud import expect_points
from fcos_lidar_jax.inference.records import as_records, confident
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.trainer.prediction import Prediction, predict


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detect boxes in point files and write them as JSON.

    A box is [x, y, z, l, w, h, yaw, vx, vy]: centre, length along the heading, width, height in metres, yaw in
    radians counter-clockwise from +x, velocity in m/s, all in the frame of the points.
    """

    files: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT")]]
    """Point files, one cloud each (.pcd.bin, .bin, .npy, .npz or .pcd), or folders of them."""
    checkpoint: Annotated[Path, tyro.conf.arg(metavar="C")]
    """Trained detector: a checkpoint; a run, which stands for its last one, RUN/best for its best; or
    `quickstart`, which comes with the package."""
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
    batch_size: int = 1
    """Clouds that a device takes at once; more than one changes boxes and scores by rounding."""


def run(args: Detect) -> None:
    """Detect in all files, then write."""
    if bool(args.files) == (args.sweeps is not None):
        raise ValueError("detect: expected point files or --sweeps, one of the two")
    detector = load_detector(args.checkpoint)
    projection = detector.config.projection
    clouds = CloudFiles(
        find_clouds(args.files) if args.sweeps is None else (args.sweeps,),
        detector.sensor,
        args.remove_close or projection.remove_close,
        projection.close_m,
        columns=args.columns,
        dtype=args.dtype,
    )
    progress = Progress("files", len(clouds))
    results: list[dict[str, Any]] = []
    for prediction in predict(detector, clouds, batch_size=args.batch_size):
        file, found, cloud = clouds.files[prediction.index], prediction.detections, prediction.cloud
        assert cloud is not None
        expect_points(file, cloud, int(found.num_dropped), detector.sensor)
        boxes = as_records(found, detector.classes, min_score=args.min_score)
        results.append(
            {
                "file": str(file),
                "num_points": cloud.num_points,
                "num_dropped": int(found.num_dropped) + cloud.num_removed,
                "num_close": cloud.num_close,
                "num_invalid": cloud.num_invalid,
                "num_truncated": cloud.num_truncated,
                "boxes": boxes,
            }
        )
        if args.pictures is not None:
            _draw(args, file, prediction, detector.sensor.limit_xy_m, detector.classes)
        progress.show(len(results), f"{file}: {len(boxes)} boxes")
    record = {"files": results}
    atomic_write(args.out, lambda path: path.write_text(json.dumps(record, indent=1), encoding="utf-8"))


def _draw(args: Detect, file: Path, prediction: Prediction, limit_m: float, classes: tuple[str, ...]) -> None:
    from fcos_lidar_jax.visualization.bev import draw_bev

    assert args.pictures is not None
    assert prediction.frame is not None
    least = max(args.min_score, 0.1)
    args.pictures.mkdir(parents=True, exist_ok=True)
    path = args.pictures / f"{prediction.index + 1:04d}_{file.name}.png"
    draw_bev(
        prediction.frame.points,
        path,
        detections=confident(prediction.detections, least),
        limit_m=limit_m,
        classes=classes,
        title=f"{path.stem}: boxes of score {least:g} and more",
    )
