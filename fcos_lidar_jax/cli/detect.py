"""``fcos-lidar detect``: the boxes of point files."""

import contextlib
import dataclasses
import itertools
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tyro

from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import (
    check_at_least,
    check_out_file,
    check_out_folder,
    check_outputs,
    check_outside,
    check_score,
)
from fcos_lidar_jax.cli.options import alignment_of, option
from fcos_lidar_jax.cli.result_files import check_result_files, check_results, result_files
from fcos_lidar_jax.data.cloud_policy import no_usable_points, truncation, unusable_clouds
from fcos_lidar_jax.data.clouds import CloudFiles, find_clouds
from fcos_lidar_jax.data.frame import files_fingerprint
from fcos_lidar_jax.data.point_files import ENDINGS, MAX_POINTS
from fcos_lidar_jax.data.recorded import usual_sensor
from fcos_lidar_jax.data.sweeps import ListedSweep, read_list
from fcos_lidar_jax.evaluation.json_io import write_lines
from fcos_lidar_jax.evaluation.records import cloud_record, confident, read_boxes, select
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.files import file_lock
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.inference.alignment import Alignment
from fcos_lidar_jax.inference.prediction import predict_groups
from fcos_lidar_jax.inference.prediction_log import detections_fingerprint
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import KITTI_HDL64E, Sensor, sensor_to_json
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.page import SHOWN_SCORE, PageFrame, page_frame, write_page
from fcos_lidar_jax.visualization.rerun_recording import check_rerun, rerun_recording

_INPUT = f"Point files ({', '.join(ENDINGS)}), one cloud per file, or folders of them."


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detect boxes in point files and write them as JSON, or in the format of an annotation tool.

    A box is [x, y, z, l, w, h, yaw, vx, vy]: centre, length along the heading, width and height in metres, yaw in
    radians counter-clockwise from +x, velocity in m/s, all in the frame of the points.

    After Ctrl-C or a kill, the same command resumes and repeats only a few clouds, even if files were added or
    removed since. A file that is given twice is processed once.
    """

    files: tyro.conf.Positional[Annotated[tuple[Path, ...], option("INPUT", text=_INPUT)]]
    checkpoint: options.Detector
    out: Annotated[Path, option("FILE")]  # File to write.
    output_format: options.OutputFormat = "json"
    calibration: options.Calibration = None
    sweeps: Annotated[Path | None, option("FILE.json")] = None
    """Sweeps to fuse, instead of INPUT: [{"file", "timestamp_us", "sensor_to_world": 4x4}, ...], newest first."""
    data_sensor: options.DataSensor = None
    yaw_deg: options.Yaw = None
    intensity_scale: options.IntensityScale = None
    full_turn: options.FullTurn = False
    min_score: options.MinScore = None
    labels: options.Labels = None
    remove_close: options.Close = None
    pictures: Annotated[Path | None, option("DIR")] = None
    """Also draw every cloud with its boxes, in bird's-eye view."""
    page: options.Page = None
    rrd: options.Rrd = None
    columns: options.Columns = None
    dtype: options.Dtype = None
    viewpoint: options.Viewpoint = False
    max_file_points: options.MaxFilePoints = MAX_POINTS
    batch_size: options.BatchSize = 1
    backend: options.Backend = "xla"


def run(args: Detect) -> None:
    """Detect in all files, then write; finished files are kept in a log beside the output until then."""
    files, sweeps = _inputs(args)
    parts = [Path(sweep.file) for sweep in sweeps]
    _check(args, [*files, *parts])
    detector = load_detector(args.checkpoint, backend=args.backend)
    place: dict[str, Any] = msgspec.to_builtins(sweeps[0]) if sweeps else {}  # of the current sweep
    check_results(args, detector.classes, posed=bool(sweeps), clouds=parts[:1] or files)
    aligned = alignment_of(args, detector.sensor, parts or files)
    if len(parts) > (num_sweeps := detector.config.num_sweeps):
        line = f"fuses the first {num_sweeps} of {len(parts)} sweeps, as the detector was trained"
        aligned = dataclasses.replace(aligned, notes=(*aligned.notes, f"{args.sweeps}: {line}"))
    clouds = _clouds(args, files, detector, aligned.data)
    states = [files_fingerprint(clouds.sources(i), Path("/"), str(file)) for i, file in enumerate(files)]
    with _resume_log(args, detector, aligned) as log:
        _detect(args, detector, aligned, clouds, states, log)
        lines = (entry[1:-1] for _, entry in log.entries(states))  # an entry is a list of one record
        if args.output_format == "json":
            write_lines(args.out, b'{"files": [', lines, b"]}\n")
        else:
            how = {"annotator": f"fcos-lidar, {args.checkpoint.name}", "calibration": args.calibration}
            with result_files(args.output_format, args.out, detector.classes, **how) as write:
                for line in lines:
                    write({**json.loads(line), **place})
        if args.page is not None or args.rrd is not None:
            _write_views(args, clouds, detector, (json.loads(entry)[0] for _, entry in log.entries(states)))


def _inputs(args: Detect) -> tuple[tuple[Path, ...], list[ListedSweep]]:
    """The files, each once; or the list of sweeps, and its entries with the paths of their files."""
    if bool(args.files) == (args.sweeps is not None):
        raise ValueError("detect: expected either point files or --sweeps")
    if args.sweeps is not None and args.full_turn:
        raise ValueError("--full-turn: expected none with --sweeps, which keeps all points")
    for file in args.files:
        if file.suffix.lower() == ".json":
            raise ValueError(f"{file}: expected a point file, or --sweeps before a list of sweeps")
    if args.sweeps is None:
        distinct = dict[str, Path]()
        for file in find_clouds(args.files):
            distinct.setdefault(os.path.abspath(file), file)
        files = tuple(distinct.values())
        if args.full_turn and not any(usual_sensor(file) == KITTI_HDL64E for file in files):
            raise ValueError(f"--full-turn: expected none for {files[0]}: only files of KITTI are cropped")
        return files, []
    if args.sweeps.suffix != ".json":
        raise ValueError(f"--sweeps: {args.sweeps}: expected a file that ends in .json")
    folder, sweeps = args.sweeps.parent, read_list(args.sweeps)
    return (args.sweeps,), [msgspec.structs.replace(each, file=str(folder / each.file)) for each in sweeps]


def _check(args: Detect, read: Sequence[Path]) -> None:
    """Check the options, and that no output replaces a file to read."""
    check_at_least(args, 1, "batch_size", "max_file_points")
    check_score(args)
    log = _log_file(args)
    if args.rrd is not None:
        check_rerun()
    check_result_files(args, read)
    check_out_file("--out", log, keep=read)
    check_outputs(args.checkpoint, [*read, args.out, log], page=args.page, rrd=args.rrd)
    if args.pictures is not None:
        check_outside("--pictures", args.pictures, args.checkpoint)
        check_out_folder(args.pictures, "--pictures")


def _clouds(args: Detect, files: tuple[Path, ...], detector: CloudDetector, sensor: Sensor) -> CloudFiles:
    reading = detector.config.reading
    return CloudFiles(
        files,
        sensor,
        dataclasses.replace(reading, remove_close=args.remove_close or reading.remove_close),
        columns=args.columns,
        dtype=args.dtype,
        viewpoint=args.viewpoint,
        max_points=args.max_file_points,
        full_turn=args.full_turn,
    )


def _log_file(args: Detect) -> Path:
    out = args.out if args.out.name else args.out.absolute()  # such as ".", for KITTI's files
    return out.parent / f".{out.name}.resume_log"


@contextlib.contextmanager
def _resume_log(args: Detect, detector: CloudDetector, aligned: Alignment) -> Iterator[ResumeLog]:
    """The log of the files that an interrupted call with the same options has finished; deleted in the end."""
    file = _log_file(args)
    same = args.remove_close, args.columns, args.dtype, args.min_score, args.labels, args.batch_size
    same += sensor_to_json(aligned.data), aligned.yaw_rad, args.full_turn, args.viewpoint
    with file_lock(file) as held:
        if not held:
            raise BlockingIOError(f"{args.out}: in use: another process is detecting, expected no other process")
        with ResumeLog(file, detections_fingerprint(detector, *same)) as log:
            try:
                yield log
            except BaseException:
                if not file.stat().st_size:
                    file.unlink()
                raise
        file.unlink(missing_ok=True)


def _detect(
    args: Detect,
    detector: CloudDetector,
    aligned: Alignment,
    clouds: CloudFiles,
    states: Sequence[str],
    log: ResumeLog,
) -> None:
    """Detect in the files whose present state is not in the log or whose picture is missing."""
    pictures = [
        None if args.pictures is None else args.pictures / f"{index:04d}_{file.name}.png"
        for index, file in enumerate(clouds.files, 1)
    ]
    todo = [
        index
        for index, (state, picture) in enumerate(zip(states, pictures, strict=True))
        if state not in log or (picture is not None and not _drawn(picture, state, log))
    ]
    progress, num_truncated, unusable = Progress("files", len(clouds)), 0, dict[str, Any]()
    if done := len(states) - len(todo):
        progress.show(done, "detected before")
    how: dict[str, Any] = {"batch_size": args.batch_size, "yaw_rad": aligned.yaw_rad, "notes": aligned.notes}
    groups = predict_groups(detector, clouds, indices=todo, **how)

    def finish(index: int, entries: list[dict[str, Any]]) -> None:
        log.add(states[index], entries)
        if (picture := pictures[index]) is not None:
            log.add(_token(picture), [{"of": states[index]}])

    for number, prediction in enumerate(itertools.chain.from_iterable(groups), done + 1):
        index, detections, cloud = prediction.index, prediction.detections, prediction.cloud
        assert prediction.frame is not None
        assert cloud is not None
        file, points = clouds.files[index], prediction.frame.points
        line = no_usable_points(file, cloud, int(detections.num_dropped), detector.sensor)
        min_score = args.min_score if line is None else math.inf  # without usable points, no boxes
        detections = select(detections, detector.classes, min_score=min_score, labels=args.labels)
        shown_score = SHOWN_SCORE if args.min_score is None else args.min_score
        if (picture := pictures[index]) is not None:
            _draw(picture, points, detections, detector, shown_score)
        record = cloud_record(detections, cloud, detector.classes)
        if line is None:
            finish(index, [{"file": str(file), **record}])
        else:
            unusable[line] = index, [{"file": str(file), **record}]
        num_truncated += cloud.num_truncated
        scores = [box["score"] for box in record["boxes"]]
        clear = sum(score >= shown_score for score in scores)
        progress.show(number, f"{file}: {len(scores)} boxes, {clear} of score {shown_score:g} and more")
    if line := unusable_clouds([*unusable], len(clouds)):
        tell(f"note: {line}")
    for finished in unusable.values():  # not before: if all are unusable, the next call must fail, too
        finish(*finished)
    if line := truncation(num_truncated, detector.config):
        tell(line)


def _token(picture: Path) -> str:
    """Key of a picture in the log of finished files."""
    return f"picture {picture.absolute()}"


def _drawn(picture: Path, state: str, log: ResumeLog) -> bool:
    """Whether a picture shows this state of its file. Once files are added, its number belongs to another file."""
    token = _token(picture)
    if token not in log or not picture.exists():
        return False
    (_, entry), *_ = log.entries([token])
    return json.loads(entry)[0]["of"] == state


def _draw(
    path: Path, points: np.ndarray, detections: Detections, detector: CloudDetector, min_score: float
) -> None:
    from fcos_lidar_jax.visualization.bev import draw_bev

    path.parent.mkdir(parents=True, exist_ok=True)
    limit_m, title = detector.sensor.limit_xy_m, f"{path.stem}: boxes of score {min_score:g} and more"
    boxes = confident(detections, min_score)
    draw_bev(points, path, detections=boxes, limit_m=limit_m, classes=detector.classes, title=title)


def _write_views(
    args: Detect, clouds: CloudFiles, detector: CloudDetector, results: Iterable[dict[str, Any]]
) -> None:
    """Write the page and the recording for rerun.

    Reads all clouds again, because an interrupted call may have detected in some of them.
    """
    frames = list[PageFrame]()
    min_score = SHOWN_SCORE if args.min_score is None else args.min_score
    with rerun_recording(args.rrd, detector.classes, min_score=min_score) as record_rerun:
        for index, result in enumerate(results):
            points, name = clouds.frame(index).points, clouds.files[index].name
            found = read_boxes(result, detector.classes)
            record_rerun(points, found, name=name)
            if args.page is not None:
                frames.append(page_frame(points, found, name=name))
    if args.page is not None:
        title = f"Boxes of {args.checkpoint.name}"
        write_page(args.page, frames, clouds.sensor, classes=detector.classes, title=title, min_score=min_score)
