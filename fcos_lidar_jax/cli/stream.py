"""``fcos-lidar stream``: the boxes of a drive, sweep by sweep."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from fcos_lidar_jax.cli.checks import check_at_least, check_out_file
from fcos_lidar_jax.data.drives import Drive, folder_drive
from fcos_lidar_jax.data.kitti_raw import is_kitti_raw, kitti_raw_drive
from fcos_lidar_jax.data.nuscenes.reader import NuScenes
from fcos_lidar_jax.data.point_files import MAX_POINTS
from fcos_lidar_jax.inference import Backend, load_detector
from fcos_lidar_jax.inference.cloud import sensor_mismatch
from fcos_lidar_jax.inference.records import as_records, confident
from fcos_lidar_jax.inference.stream import Found, detect_stream
from fcos_lidar_jax.inference.tracks import Tracks, to_world, track
from fcos_lidar_jax.input_pipeline.open import find_layout
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.visualization.page import PageFrame, page_frame, write_page


@dataclasses.dataclass(frozen=True)
class Stream:
    """Detect boxes in a drive, sweep by sweep, and write a line of JSON for each as it comes.

    Every sweep has those before it fused into its frame, as many as the detector was trained with. Boxes are those
    of `fcos-lidar detect --sweeps`.
    """

    checkpoint: Annotated[Path, tyro.conf.arg(metavar="C")]  # Trained detector, as for `fcos-lidar detect`.
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.jsonl")]  # Where the lines go.
    source: tyro.conf.Positional[Annotated[Path | None, tyro.conf.arg(metavar="SOURCE")]] = None
    """Folder of point files, one sweep each; or a recording of KITTI raw, which has its poses."""
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Poses of a folder's sweeps, from the sensor to the world: FILE.json, a list [{"file", "timestamp_us",
    "sensor_to_world": 4x4}] in the order of time; or lines `t x y z qx qy qz qw` (TUM). Without poses every sweep
    is on its own."""
    data_root: Path | None = None  # Instead of a folder: a data set in the layout of nuScenes.
    scene: str | None = None  # Its scene.
    version: str | None = None  # Its folder of tables; may be left out where there is one.
    keyframes: bool = False  # Only the scene's keyframes.
    page: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Also write a page that shows the drive: one file for any browser, which asks for nothing else."""
    track: bool = False  # Give every box the identity of its object over time; needs poses.
    min_score: float = 0.0  # Leave out boxes below this score.
    backend: Backend = "xla"  # What the network runs in, as for `fcos-lidar detect`.
    columns: int | None = None
    """Values a point in a raw file of another layout: 3, 4, 5 (the fifth is the time lag) or 6."""
    dtype: Literal["float16", "float32", "float64"] | None = None  # Number type of a raw file of another layout.
    max_file_points: int = MAX_POINTS  # Refuse a point file of more points.


def run(args: Stream) -> None:
    """Detect, write a line a sweep, and the page at the end."""
    _check(args)
    detector = load_detector(args.checkpoint, backend=args.backend)
    drive = _open(args, detector.sensor)
    if args.track and not drive.posed:
        raise ValueError("--track: found no poses, expected --poses FILE")
    if not drive.posed:
        print("no poses: every sweep is detected on its own, without those before it", file=sys.stderr)
    frames: list[PageFrame] = []
    tracks, before_us = Tracks(), None
    with args.out.open("wb", buffering=0) as lines:  # a line is one write, so that interruptions leave whole ones
        for found in detect_stream(drive.sweeps, detector, num_sweeps=None if drive.posed else 1):
            points = found.cloud.points[found.cloud.valid]
            if before_us is None and (line := sensor_mismatch(points, detector.sensor)):
                print(f"warning: {line}", file=sys.stderr)
            record = _record(found, detector.classes, args.min_score, posed=drive.posed)
            boxes, labels, scores = confident(found.detections, args.min_score)
            ids = None
            if args.track:
                dt = 0.0 if before_us is None else (found.sweep.time_us - before_us) / 1e6
                tracks, ids = track(tracks, to_world(boxes, found.sweep.sensor_to_world), labels, scores, dt)
                record["boxes"] = [b | {"track": int(i)} for b, i in zip(record["boxes"], ids, strict=True)]
            lines.write(json.dumps(record).encode() + b"\n")
            if args.page is not None:
                frames.append(page_frame(found.sweep, boxes, labels, scores, ids, posed=drive.posed))
            before_us = found.sweep.time_us
    if args.page is not None:
        write_page(args.page, frames, classes=detector.classes, title=args.scene or str(args.source))


def _check(args: Stream) -> None:
    check_at_least(args, 1, "max_file_points")
    if not 0 <= args.min_score <= 1:
        raise ValueError(f"--min-score: got {args.min_score:g}, expected a score of 0 to 1")
    if (args.source is None) == (args.data_root is None):
        raise ValueError("stream: expected a folder of point files or --data-root, one of the two")
    if (args.data_root is None) != (args.scene is None):
        raise ValueError("stream: expected --data-root and --scene together")
    own = ("poses", "columns", "dtype") if args.source is None else ("version", "keyframes")
    if given := [name for name in own if getattr(args, name)]:
        where = "a folder of point files" if args.source is None else "--data-root"
        raise ValueError(f"--{given[0]}: expected with {where} alone")
    keep = [path for path in (args.source, args.poses) if path is not None and path.is_file()]
    check_out_file("--out", args.out, keep=keep)
    if args.page is not None:
        check_out_file("--page", args.page, keep=[*keep, args.out])
    args.out.parent.mkdir(parents=True, exist_ok=True)


def _open(args: Stream, sensor: Sensor) -> Drive:
    if args.source is not None:
        if args.poses is None and is_kitti_raw(args.source):
            return kitti_raw_drive(args.source, sensor, max_points=args.max_file_points)
        layout: dict[str, Any] = {"columns": args.columns, "dtype": args.dtype}
        return folder_drive(args.source, sensor, args.poses, max_points=args.max_file_points, **layout)
    assert args.data_root is not None
    assert args.scene is not None
    version = find_layout(args.data_root, "nuscenes", args.version).version
    assert version is not None
    return Drive(NuScenes(args.data_root, version).drive(args.scene, keyframes=args.keyframes))


def _record(found: Found, classes: tuple[str, ...], min_score: float, *, posed: bool) -> dict[str, Any]:
    """A line's content, in the words of ``fcos-lidar detect``; null where it is not known."""
    cloud, sweep = found.cloud, found.sweep
    dropped = int(found.detections.num_dropped) + cloud.num_removed
    record: dict[str, Any] = {"file": sweep.name, "timestamp_us": sweep.time_us if posed else None}
    record |= {"sensor_to_world": np.asarray(sweep.sensor_to_world).tolist() if posed else None}
    record |= {"num_points": cloud.num_points, "num_dropped": dropped}
    record |= {name: getattr(cloud, name) for name in ("num_close", "num_invalid", "num_truncated")}
    return record | {"boxes": as_records(found.detections, classes, min_score=min_score)}
