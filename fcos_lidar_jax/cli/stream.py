"""``fcos-lidar stream``: the boxes of a drive, one sweep after the other."""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Excludes, Needs, Or, Output, option_name
from fcos_lidar_jax.cli.options import alignment_of, option
from fcos_lidar_jax.cli.sinks import check_results, closing_at_failure, open_sinks
from fcos_lidar_jax.data.box_geometry import transform_boxes
from fcos_lidar_jax.data.cloud_policy import truncation, unusable_clouds
from fcos_lidar_jax.data.clouds import find_clouds
from fcos_lidar_jax.data.drives import Drive
from fcos_lidar_jax.data.point_files import MAX_POINTS
from fcos_lidar_jax.data.sweeps import Sweep
from fcos_lidar_jax.evaluation.records import cloud_record, read_boxes, select
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.inference.stream import detect_stream
from fcos_lidar_jax.inference.tracks import Tracks, track
from fcos_lidar_jax.input_pipeline.open_drive import FOLDER, RECORDINGS, SCENE, Recording, find_recording
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor, in_frame_of

_OPTIONS = {
    **{name: name for name in ("poses", "topic", "odometry", "columns", "dtype", "viewpoint")},
    **{name: name for name in ("version", "index", "keyframes", "allow_missing_sweeps", "follow_links")},
    "max_file_points": "max_points",
}
"""Options that not every kind of drive takes, and the names that their functions give them."""

_TRACKED_SCORE = 0.5  # Of boxes with lower scores, most are on no object, and their tracks last for a few sweeps.


@dataclasses.dataclass(frozen=True)
class Stream:
    """Detect boxes in a drive, and write one line of JSON per sweep as soon as it is ready, or another file
    format.

    Each sweep is fused with older sweeps, as many as the detector was trained with. The boxes are the same as from
    `fcos-lidar detect --sweeps`.
    """

    checkpoint: options.Detector
    out: Annotated[Path, Output.RESULT, option("FILE.jsonl")]  # File to write; an earlier file is replaced.
    output_format: options.OutputFormat = "json"
    calibration: options.Calibration = None
    source: tyro.conf.Positional[
        Annotated[Path | None, Or("data_root"), option("SOURCE", default="the scene of --data-root")]
    ] = None
    """Folder of point files, one per sweep; ROS 1 (.bag) or ROS 2 (folder, .mcap, .db3) recording; KITTI raw
    drive; or Argoverse 2 log."""
    poses: Annotated[
        Path | None,
        Excludes(("odometry",), "a drive has one set of poses"),
        option("FILE", default="the poses of the source; without poses, sweeps are not fused"),
    ] = None
    """Poses from sensor to world, for a folder or a ROS recording: lines `t x y z qx qy qz qw` (TUM) or, for a
    folder, FILE.json: [{"file", "timestamp_us", "sensor_to_world": 4x4}, ...], oldest first."""
    topic: Annotated[str | None, option("T", default="the only one")] = None
    """ROS: topic of the PointCloud2 messages."""
    odometry: Annotated[str | None, option("T|tf")] = None
    """ROS: poses from a topic (Odometry, PoseStamped or PoseWithCovarianceStamped) or from tf."""
    data_root: Annotated[
        Path | None, Needs("scene"), Excludes(("source",), "it takes the place of SOURCE"), option("DIR")
    ] = None
    """Data set in the nuScenes layout, instead of SOURCE."""
    scene: Annotated[str | None, Needs("data_root"), option("NAME")] = None
    """With --data-root: the scene to detect in."""
    version: Annotated[str | None, option("NAME", default="the only one")] = None
    """With --data-root: folder of the tables."""
    index: Annotated[Path | None, option("DIR", default="DATA_ROOT/.fcos_lidar/VERSION")] = None
    """With --data-root: folder of the index, as given to `fcos-lidar prepare --index`."""
    keyframes: bool = False  # With --data-root: detect in keyframes only, still fusing the sweeps between them.
    allow_missing_sweeps: bool = False  # With --data-root: skip missing sweeps, but never a keyframe.
    follow_links: bool = False  # With --data-root: follow links that lead out of DATA_ROOT.
    page: options.Page = None
    rrd: options.Rrd = None
    data_sensor: options.DataSensor = None
    yaw_deg: options.Yaw = None
    intensity_scale: Annotated[
        options.IntensityScale, Excludes(("data_root",), "nuScenes has intensities of 0 to 255")
    ] = None
    track: bool = False  # Track objects: each box gets the identity of its object. Needs poses.
    min_score: Annotated[
        options.Score,
        option(
            "SCORE", default=f"{_TRACKED_SCORE} with --track, else 0; pages and Rerun files show boxes from 0.3"
        ),
    ] = None
    """Leave out boxes with a lower score, before tracking."""
    labels: options.Labels = None
    backend: options.Backend = "xla"
    columns: options.Columns = None
    dtype: options.Dtype = None
    viewpoint: options.Viewpoint = False
    max_file_points: options.MaxFilePoints = MAX_POINTS


def run(args: Stream, *, in_lines: bool = True) -> None:
    """Detect, and add every sweep to all outputs as soon as it is ready. With ``in_lines``, JSON has one line per
    sweep, otherwise the layout of ``fcos-lidar detect``.
    """
    if args.track and args.min_score is None:
        args = dataclasses.replace(args, min_score=_TRACKED_SCORE)
    kind, began = _find(args), time.monotonic()
    detector = load_detector(args.checkpoint, backend=args.backend)
    classes, sensor, source = detector.classes, detector.sensor, args.source or args.data_root or Path()
    paths = find_clouds((source,)) if kind is FOLDER else [source]
    scene_sensor = in_frame_of(sensor, NUSCENES_HDL32E) if kind is SCENE else None
    aligned = alignment_of(args, sensor, paths, scene_sensor)
    drive = _open(args, kind, detector, aligned.data)
    _tell_notes(drive.notes)
    how: dict[str, Any] = {"aligned": aligned, "at_us": drive.at_us}
    if not drive.posed:
        how["reading"] = dataclasses.replace(detector.config.reading, num_sweeps=1)
    notes, num_truncated, progress = list[str | None](), 0, Progress("sweeps", None)
    add_tracks = _tracker(classes)
    views = {"title": args.scene or str(args.source), "in_lines": in_lines}
    with contextlib.ExitStack() as sinks:
        sinks.callback(_tell_notes, drive.notes)  # also if the source fails
        add = sinks.enter_context(open_sinks(args, classes, aligned.data, **views))
        with closing_at_failure(sinks, notes) if in_lines else contextlib.nullcontext():
            for found in detect_stream(_in_order(drive), detector, **how):
                assert found.sweep is not None
                assert found.cloud is not None
                kept = select(found.detections, classes, min_score=args.min_score, labels=args.labels)
                record = _place(found.sweep, drive) | cloud_record(kept, found.cloud, classes)
                if args.track:
                    add_tracks(record["boxes"], found.sweep)
                if args.output_format != "json":
                    record["token"] = drive.tokens.get(found.sweep.time_us)
                add(record, found.sweep.points[:, :4])
                notes.append(found.note)
                num_truncated += found.cloud.num_truncated
                progress.show(len(notes), f"{found.sweep.name}: {len(record['boxes'])} boxes")
        if line := unusable_clouds([*filter(None, notes)], len(notes)):
            drive.notes.append(line)
    if line := truncation(num_truncated, detector.config):
        tell(line)
    tell(f"{len(notes)} sweeps in {time.monotonic() - began:.1f} s, with loading and compiling")


def _in_order(drive: Drive) -> Iterator[Sweep]:
    """Yield the sweeps; with poses, only sweeps that are later than all earlier ones. A note counts the others."""
    latest_us, others = -math.inf, list[str]()
    try:
        for sweep in drive.sweeps:
            if sweep.time_us <= latest_us:
                others.append(sweep.name)
            if sweep.time_us > latest_us or not drive.posed:
                yield sweep
            latest_us = max(latest_us, sweep.time_us)
    finally:
        if others:
            how = "skipped" if drive.posed else "kept, since the order only matters with poses"
            found = f"sweeps that are not later than all before: {len(others)}, the first is {others[0]}"
            drive.notes.append(f"{found}; {how}")


def _tracker(classes: tuple[str, ...]) -> Callable[[list[dict[str, Any]], Sweep], None]:
    """A function that adds the numbers of their tracks to the boxes of one sweep after another."""
    tracks, before_us = Tracks(), None

    def add_tracks(records: list[dict[str, Any]], sweep: Sweep) -> None:
        nonlocal tracks, before_us
        boxes, labels, scores = read_boxes({"boxes": records}, classes)
        dt = 0.0 if before_us is None else (sweep.time_us - before_us) / 1e6
        tracks, ids = track(tracks, transform_boxes(boxes, sweep.sensor_to_world), labels, scores, dt)
        before_us = sweep.time_us
        for record, number in zip(records, ids.tolist(), strict=True):
            record["track"] = number

    return add_tracks


def _tell_notes(notes: list[str]) -> None:
    while notes:
        tell(f"note: {notes.pop(0)}")


def _find(args: Stream) -> Recording:
    """The kind of the drive; rejects options that do not fit it."""
    kind = find_recording(args.source or Path(), scene=args.scene, poses=args.poses)
    for field, name in _OPTIONS.items():
        if getattr(args, field) != getattr(Stream, field) and name not in kind.options:
            fitting = " or ".join(each.title for each in RECORDINGS if name in each.options)
            raise ValueError(f"{option_name(field)}: expected only with {fitting}")
    if args.output_format == "nuscenes" and args.data_root is not None and not args.keyframes:
        raise ValueError("--output-format nuscenes: expected --keyframes with --data-root: samples are keyframes")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    return kind


def _open(args: Stream, kind: Recording, detector: CloudDetector, sensor: Sensor) -> Drive:
    options: dict[str, Any] = {name: getattr(args, field) for field, name in _OPTIONS.items()}
    options |= {"scene": args.scene, "num_sweeps": detector.config.num_sweeps}
    given = {name: options[name] for name in kind.options}
    drive = kind.open(args.source or args.data_root, sensor, **given)
    if args.track and not drive.posed:
        raise ValueError("--track: found no poses, expected --poses FILE, or --odometry for a ROS recording")
    check_results(args, detector.classes, posed=drive.posed)
    if not drive.posed:
        tell("no poses: every sweep is detected on its own, without earlier sweeps")
    return drive


def _place(sweep: Sweep, drive: Drive) -> dict[str, Any]:
    """The first fields of a line; unknown values are null."""
    return {
        "file": sweep.name,
        "timestamp_us": sweep.time_us if drive.timed else None,
        "sensor_to_world": np.asarray(sweep.sensor_to_world).tolist() if drive.posed else None,
    }
