"""``fcos-lidar stream``: the boxes of a drive, one sweep after the other."""

import contextlib
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import check_at_least, check_outputs, check_score, option_name
from fcos_lidar_jax.cli.options import alignment_of, option
from fcos_lidar_jax.cli.result_files import FORMATS, check_result_files, check_results, result_files
from fcos_lidar_jax.data.cloud_policy import sensor_mismatch, truncation, unusable_clouds
from fcos_lidar_jax.data.clouds import find_clouds
from fcos_lidar_jax.data.drives import Drive
from fcos_lidar_jax.data.point_files import ENDINGS, MAX_POINTS
from fcos_lidar_jax.data.sweeps import Sweep
from fcos_lidar_jax.evaluation.records import cloud_record, confident, select
from fcos_lidar_jax.files import line_writer
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.inference.alignment import Alignment
from fcos_lidar_jax.inference.stream import SweepDetections, detect_stream
from fcos_lidar_jax.inference.tracks import Tracks, to_world, track
from fcos_lidar_jax.input_pipeline.open_drive import FOLDER, RECORDINGS, SCENE, Recording, find_recording
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor, in_frame_of
from fcos_lidar_jax.visualization.page import SHOWN_SCORE, PageFrame, page_frame, write_page
from fcos_lidar_jax.visualization.rerun_recording import check_rerun, rerun_recording

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
    out: Annotated[Path, option("FILE.jsonl")]  # File to write; an earlier file is replaced.
    output_format: options.OutputFormat = "json"
    calibration: options.Calibration = None
    source: tyro.conf.Positional[Annotated[Path | None, option("SOURCE")]] = None
    """Folder of point files, one per sweep; ROS 1 (.bag) or ROS 2 (folder, .mcap, .db3) recording; KITTI raw
    drive; or Argoverse 2 log."""
    poses: Annotated[
        Path | None, option("FILE", default="the poses of the source; without poses, sweeps are not fused")
    ] = None
    """Poses from sensor to world, for a folder or a ROS recording: lines `t x y z qx qy qz qw` (TUM) or, for a
    folder, FILE.json: [{"file", "timestamp_us", "sensor_to_world": 4x4}, ...], oldest first."""
    topic: Annotated[str | None, option("T", default="the only one")] = None
    """ROS: topic of the PointCloud2 messages."""
    odometry: Annotated[str | None, option("T|tf")] = None
    """ROS: poses from a topic (Odometry, PoseStamped or PoseWithCovarianceStamped) or from tf."""
    data_root: Annotated[Path | None, option("DIR")] = None  # Data set in the nuScenes layout, instead of SOURCE.
    scene: Annotated[str | None, option("NAME")] = None  # With --data-root: the scene to detect in.
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
    intensity_scale: options.IntensityScale = None
    track: bool = False  # Track objects: each box gets the identity of its object. Needs poses.
    min_score: Annotated[
        float | None,
        option(
            "SCORE", default=f"{_TRACKED_SCORE} with --track, else 0; pages and recordings show boxes from 0.3"
        ),
    ] = None
    """Leave out boxes with a lower score, before tracking."""
    labels: options.Labels = None
    backend: options.Backend = "xla"
    columns: options.Columns = None
    dtype: options.Dtype = None
    viewpoint: options.Viewpoint = False
    max_file_points: options.MaxFilePoints = MAX_POINTS


def run(args: Stream) -> None:
    """Detect, write one line per sweep, and the page at the end."""
    if args.track and args.min_score is None:
        args = dataclasses.replace(args, min_score=_TRACKED_SCORE)
    kind = _find(args)
    detector = load_detector(args.checkpoint, backend=args.backend)
    source = args.source or args.data_root or Path()
    paths, sensor = find_clouds((source,)) if kind is FOLDER else [source], detector.sensor
    scene_sensor = in_frame_of(sensor, NUSCENES_HDL32E) if kind is SCENE else None
    aligned = alignment_of(args, sensor, paths, scene_sensor)
    drive = _open(args, kind, detector, aligned.data)
    _tell_notes(drive.notes)
    frames: list[PageFrame] = []
    tracks, before_us, num_truncated, num_points = Tracks(), None, 0, 0
    unusable, progress = list[str | None](), Progress("sweeps", None)
    shown_score = SHOWN_SCORE if args.min_score is None else args.min_score
    with (
        rerun_recording(args.rrd, detector.classes, min_score=shown_score) as record_rerun,
        _write_lines(args, detector.classes) as write_line,
        _Timing() as timing,
    ):
        how: dict[str, Any] = {"sensor": aligned.data, "yaw_rad": aligned.yaw_rad, "at_us": drive.at_us}
        if not drive.posed:
            how["reading"] = dataclasses.replace(detector.config.reading, num_sweeps=1)
        detect = functools.partial(detect_stream, detector=detector, **how)
        for found in timing.detect(_announcing(drive.sweeps, aligned), detect):
            points = found.cloud.points[found.cloud.valid]
            if not num_points and (line := sensor_mismatch(_untruncated(found.sweep, aligned), detector.sensor)):
                tell(f"warning: {line}")
            num_points += len(points)
            unusable.append(found.unusable)
            kept = select(found.detections, detector.classes, min_score=args.min_score, labels=args.labels)
            record = _record(dataclasses.replace(found, detections=kept), detector.classes, drive)
            boxes, labels, scores = confident(kept, 0.0)
            ids = None
            if args.track:
                dt = 0.0 if before_us is None else (found.sweep.time_us - before_us) / 1e6
                tracks, ids = track(tracks, to_world(boxes, found.sweep.sensor_to_world), labels, scores, dt)
                record["boxes"] = [b | {"track": int(i)} for b, i in zip(record["boxes"], ids, strict=True)]
            token = drive.tokens.get(found.sweep.time_us)
            write_line(record if args.output_format == "json" else {**record, "token": token})
            details = {"name": Path(found.sweep.name).name, "ids": ids}
            if drive.posed:
                details |= {"time_us": found.sweep.time_us, "pose": found.sweep.sensor_to_world}
            points = found.sweep.points[:, :4]
            record_rerun(points, (boxes, labels, scores), **details)
            if args.page is not None:
                frames.append(page_frame(points, (boxes, labels, scores), **details))
            before_us, num_truncated = found.sweep.time_us, num_truncated + found.cloud.num_truncated
            progress.show(len(unusable), f"{found.sweep.name}: {len(boxes)} boxes")
        if line := unusable_clouds([*filter(None, unusable)], len(unusable)):
            drive.notes.append(line)
    _tell_notes(drive.notes)
    if line := truncation(num_truncated, detector.config):
        tell(line)
    tell(timing.summary())
    if args.page is not None:
        title = args.scene or str(args.source)
        write_page(args.page, frames, aligned.data, classes=detector.classes, title=title, min_score=shown_score)


@contextlib.contextmanager
def _write_lines(args: Stream, classes: tuple[str, ...]) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A function that writes a record as a line, or in another format. The first line replaces an earlier file."""
    with contextlib.ExitStack() as stack:
        if args.output_format != "json":
            how = {"annotator": f"fcos-lidar, {args.checkpoint.name}", "calibration": args.calibration}
            yield stack.enter_context(result_files(args.output_format, args.out, classes, **how))
            return
        opened: list[Callable[[bytes], None]] = []

        def write(record: dict[str, Any]) -> None:
            if not opened:
                opened.append(stack.enter_context(line_writer(args.out)))
            opened[0](json.dumps(record).encode())

        yield write


def _untruncated(sweep: Sweep, aligned: Alignment) -> np.ndarray:
    """Points of a sweep in the detector's frame, before the truncation, which would hide a denser sensor."""
    points = sweep.points.copy()
    points[:, 4] = 0
    return aligned.points(points)


def _announcing(sweeps: Iterable[Sweep], aligned: Alignment) -> Iterator[Sweep]:
    """The sweeps. After reading the first one, print the notes, and say that the detector is compiled."""
    for number, sweep in enumerate(sweeps):
        if not number:
            aligned.tell_notes()
            tell("compiling the detector")
        yield sweep


def _tell_notes(notes: list[str]) -> None:
    while notes:
        tell(f"note: {notes.pop(0)}")


class _Timing(contextlib.AbstractContextManager):
    """Seconds per sweep and stage, and the number of programs compiled after the first sweep."""

    def __init__(self) -> None:
        self._seconds, self._programs = list[tuple[float, float, float]](), 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def __exit__(self, *error: object) -> None:
        jax.monitoring.unregister_event_duration_listener(self._listen)

    def _listen(self, event: str, *_: object, **__: object) -> None:
        self._programs += event.endswith("/backend_compile_duration")

    def detect(
        self, sweeps: Iterable[Sweep], detect: Callable[[Iterable[Sweep]], Iterator[SweepDetections]]
    ) -> Iterator[SweepDetections]:
        """Detections in sweeps. What the caller does with one until it takes the next one counts as writing."""
        reading, began = 0.0, time.perf_counter()

        def read() -> Iterator[Sweep]:
            nonlocal reading
            before = time.perf_counter()
            for sweep in sweeps:
                reading += time.perf_counter() - before  # including sweeps that are only fused
                yield sweep
                before = time.perf_counter()

        for found in detect(read()):
            ready = time.perf_counter()
            yield found
            self._seconds.append((reading, ready - began - reading, time.perf_counter() - ready))
            if len(self._seconds) == 1:
                self._programs = 0
            reading, began = 0.0, time.perf_counter()

    def summary(self) -> str:
        """A line with the medians. The first sweep, which includes the compilation, is listed separately."""
        number = len(self._seconds)
        if number < 2:
            return f"{number} sweeps"
        medians = zip(np.median(self._seconds[1:], axis=0), ("reading", "detection", "writing"), strict=True)
        later = ", ".join(f"{1e3 * seconds:.1f} ms {stage}" for seconds, stage in medians)
        first = f"the first, which compiles, {sum(self._seconds[0]):.1f} s"
        return f"{number} sweeps: {first}; the others {later} (medians), {self._programs} compilations"


def _find(args: Stream) -> Recording:
    """The kind of the drive; rejects options that do not fit it, and outputs that would replace inputs."""
    check_at_least(args, 1, "max_file_points")
    check_score(args)
    if args.data_root is not None and args.intensity_scale is not None:
        raise ValueError("--intensity-scale: expected none with --data-root: nuScenes has intensities of 0 to 255")
    if args.source is not None and not args.source.exists():
        raise ValueError(f"{args.source}: no such file or folder")
    if (args.source is None) == (args.data_root is None):
        raise ValueError("stream: expected either a folder of point files or a recording, or --data-root")
    if (args.data_root is None) != (args.scene is None):
        raise ValueError("stream: expected --data-root and --scene together")
    kind = find_recording(args.source or Path(), scene=args.scene, poses=args.poses)
    for field, name in _OPTIONS.items():
        if getattr(args, field) != getattr(Stream, field) and name not in kind.options:
            fitting = " or ".join(each.title for each in RECORDINGS if name in each.options)
            raise ValueError(f"{option_name(field)}: expected only with {fitting}")
    if args.poses is not None and args.odometry is not None:
        raise ValueError(f"--poses: expected only with {FOLDER.title}, or with a ROS recording without --odometry")
    keep = [path for path in (args.source, args.poses) if path is not None and path.is_file()]
    if args.source is not None and args.source.is_dir():
        keep += [path for path in args.source.rglob("*") if path.name.lower().endswith(ENDINGS)]
    if args.rrd is not None:
        check_rerun()
    check_result_files(args, keep)
    check_outputs(args.checkpoint, [*keep, args.out], page=args.page, rrd=args.rrd)
    if FORMATS[args.output_format].in_world and args.data_root is not None and not args.keyframes:
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


def _record(found: SweepDetections, classes: tuple[str, ...], drive: Drive) -> dict[str, Any]:
    """A line with the fields of ``fcos-lidar detect``; unknown values are null."""
    sweep = found.sweep
    return {
        "file": sweep.name,
        "timestamp_us": sweep.time_us if drive.timed else None,
        "sensor_to_world": np.asarray(sweep.sensor_to_world).tolist() if drive.posed else None,
        **cloud_record(found.detections, found.cloud, classes),
    }
