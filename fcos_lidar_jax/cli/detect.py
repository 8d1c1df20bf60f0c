"""``fcos-lidar detect``: point files to boxes."""

import contextlib
import dataclasses
import itertools
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from fcos_lidar_jax.cli.checks import check_at_least, check_out_file, check_out_folder, check_outside
from fcos_lidar_jax.data.cloud_policy import expect_points
from fcos_lidar_jax.data.clouds import CloudFiles, TurnedClouds, find_clouds
from fcos_lidar_jax.data.frame import files_fingerprint
from fcos_lidar_jax.data.point_files import MAX_POINTS
from fcos_lidar_jax.data.sweeps import about_z, read_list, sensor_before_rotation, turned
from fcos_lidar_jax.evaluation.records import as_records, confident
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.files import atomic_write, file_lock
from fcos_lidar_jax.inference import Backend, CloudDetector, load_detector
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.inference.prediction_log import detections_fingerprint
from fcos_lidar_jax.inference.tracks import to_world
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.page import PageFrame, page_frame, write_page

_CLEAR = 0.2  # Boxes of this score and more are counted on the screen.


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detect boxes in point files and write them as JSON.

    A box is [x, y, z, l, w, h, yaw, vx, vy]: centre, length along the heading, width, height in metres, yaw in
    radians counter-clockwise from +x, velocity in m/s, all in the frame of the points.

    Ctrl-C, or a kill, loses a few clouds: the same command resumes, also where files were added or removed since.
    A file that is given twice is detected in once.
    """

    files: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT")]]
    """Point files, one cloud each (.pcd.bin, .bin, .npy, .npz, .pcd or .feather), or folders of them."""
    checkpoint: Annotated[Path, tyro.conf.arg(metavar="C")]
    """Trained detector: a checkpoint; a run, which stands for its last one, RUN/best for its best; or
    `hdl32e` or `quickstart`, which come with the package."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]  # Where the JSON goes.
    sweeps: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """Instead of files: a list of sweeps to fuse, [{"file", "timestamp_us", "sensor_to_world": 4x4}], the first
    is the current one, the others follow by age. As many are fused as the detector was trained with."""
    yaw_deg: float = 0.0
    """Turn the clouds by this angle about z for the detector, and the boxes back: 90 where x points ahead and the
    detector is of nuScenes' sensor, whose y axis does (`hdl32e`)."""
    min_score: float = 0.0  # Leave out boxes below this score.
    remove_close: Literal["all", "sweeps", "none"] | None = None
    """Drop points within a metre of the sensor in x and y: of all sweeps, of the older ones, or none. Default:
    as the detector was trained."""
    pictures: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also draw every cloud with its boxes of score 0.1 and more, or of --min-score, from above."""
    page: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Also write a page that shows the clouds: one file for any browser, which asks for nothing else."""
    columns: int | None = None
    """Values a point in a raw file of another layout: 3, 4, 5 (the fifth is the time lag) or 6."""
    dtype: Literal["float16", "float32", "float64"] | None = None  # Number type of a raw file of another layout.
    max_file_points: int = MAX_POINTS  # Refuse a point file of more points.
    batch_size: int = 1  # Clouds that a device takes at once; more than one changes boxes and scores by rounding.
    backend: Backend = "xla"
    """What the network runs in; openvino is faster on CPUs, in bfloat16 where the processor has it, and needs
    pip install 'fcos-lidar-jax[cpu]'."""


def run(args: Detect) -> None:
    """Detect in all files, then write; what is done is kept beside the output until then."""
    inputs = _check(args)
    detector = load_detector(args.checkpoint, backend=args.backend)
    most = detector.config.num_sweeps
    for file, parts in inputs.items():
        if len(parts) > most:
            line = f"the first {most} of {len(parts)} sweeps are fused, as many as the detector was trained with"
            print(f"{file}: {line}", file=sys.stderr)
    clouds = _clouds(args, inputs, detector)
    states = [files_fingerprint([file, *parts], Path("/"), str(file)) for file, parts in inputs.items()]
    with _resume_log(args, detector) as log:
        _detect(args, detector, clouds, states, log)
        atomic_write(args.out, lambda path: _write_results(path, log.entries(states)))
        if args.page is not None:
            _write_page(args, clouds, detector, (json.loads(entry)[0] for _, entry in log.entries(states)))


def _check(args: Detect) -> dict[Path, tuple[Path, ...]]:
    """Refuse what cannot be done; the inputs, each with the other files that it names."""
    if bool(args.files) == (args.sweeps is not None):
        raise ValueError("detect: expected point files or --sweeps, one of the two")
    check_at_least(args, 1, "batch_size", "max_file_points")
    if not 0 <= args.min_score <= 1:
        raise ValueError(f"--min-score: got {args.min_score:g}, expected a score of 0 to 1")
    if not np.isfinite(args.yaw_deg):
        raise ValueError(f"--yaw-deg: got {args.yaw_deg:g}, expected an angle in degrees")
    for file in args.files:
        if file.suffix.lower() == ".json":
            raise ValueError(f"{file}: expected a point file, or --sweeps before a list of sweeps")
    if args.sweeps is not None and args.sweeps.suffix != ".json":
        raise ValueError(f"--sweeps: {args.sweeps}: expected a file that ends in .json")
    if args.sweeps is None:
        inputs: dict[Path, tuple[Path, ...]] = dict.fromkeys(find_clouds(args.files), ())
    else:
        inputs = {args.sweeps: tuple(args.sweeps.parent / each.file for each in read_list(args.sweeps))}
    read = [*inputs, *itertools.chain.from_iterable(inputs.values())]
    log = _log_file(args)
    check_out_file("--out", args.out, keep=read)
    check_out_file("--out", log, keep=read)
    if args.page is not None:
        check_out_file("--page", args.page, keep=(*read, args.out, log))
    if args.pictures is not None:
        check_out_folder(args.pictures, "--pictures")
    for option, out in (("--out", args.out), ("--page", args.page), ("--pictures", args.pictures)):
        check_outside(option, out, args.checkpoint)
    return inputs


def _clouds(args: Detect, files: Iterable[Path], detector: CloudDetector) -> CloudFiles:
    reading = detector.config.reading
    return CloudFiles(
        tuple(files),
        sensor_before_rotation(detector.sensor, np.deg2rad(args.yaw_deg)),
        dataclasses.replace(reading, remove_close=args.remove_close or reading.remove_close),
        columns=args.columns,
        dtype=args.dtype,
        max_points=args.max_file_points,
    )


def _log_file(args: Detect) -> Path:
    return args.out.with_name(f".{args.out.name}.resume_log")


@contextlib.contextmanager
def _resume_log(args: Detect, detector: CloudDetector) -> Iterator[ResumeLog]:
    """Records of the files that an interrupted call of these options has done; gone when all are written."""
    file = _log_file(args)
    options = args.remove_close, args.columns, args.dtype, args.yaw_deg, args.min_score, args.batch_size
    with file_lock(file) as held:
        if not held:
            raise BlockingIOError(f"{args.out}: in use: another process is detecting, expected no other process")
        with ResumeLog(file, detections_fingerprint(detector, *options)) as log:
            try:
                yield log
            except BaseException:
                if not file.stat().st_size:
                    file.unlink()
                raise
        file.unlink(missing_ok=True)


def _detect(
    args: Detect, detector: CloudDetector, clouds: CloudFiles, states: Sequence[str], log: ResumeLog
) -> None:
    """Detect in the files that are not in the log by the name of their present state, and draw them."""
    pictures = [_picture(args, index, file) for index, file in enumerate(clouds.files)]
    todo = [
        index
        for index, (state, picture) in enumerate(zip(states, pictures, strict=True))
        if state not in log or (picture is not None and not picture.exists())
    ]
    progress, back = Progress("files", len(clouds)), about_z(-np.deg2rad(args.yaw_deg))
    if done := len(states) - len(todo):
        progress.show(done, "detected before")
    seen = TurnedClouds(clouds, np.deg2rad(args.yaw_deg)) if args.yaw_deg else clouds
    predictions = predict(detector, seen, indices=todo, batch_size=args.batch_size)
    for number, prediction in enumerate(predictions, done + 1):
        index, found, cloud = prediction.index, prediction.detections, prediction.cloud
        assert prediction.frame is not None
        assert cloud is not None
        file, points = clouds.files[index], prediction.frame.points
        if args.yaw_deg:
            points = turned(points, back)
            found = dataclasses.replace(found, boxes=to_world(np.asarray(found.boxes), back).astype(np.float32))
        expect_points(file, cloud, int(found.num_dropped), detector.sensor)
        if (picture := pictures[index]) is not None:
            _draw(picture, points, found, detector, max(args.min_score, 0.1))
        boxes = as_records(found, detector.classes, min_score=args.min_score)
        dropped = int(found.num_dropped) + cloud.num_removed
        record = {"file": str(file), "num_points": cloud.num_points, "num_dropped": dropped}
        record |= {name: getattr(cloud, name) for name in ("num_close", "num_invalid", "num_truncated")}
        log.add(states[index], [record | {"boxes": boxes}])
        clear = sum(box["score"] >= _CLEAR for box in boxes)
        progress.show(number, f"{file}: {len(boxes)} boxes, {clear} of score {_CLEAR} and more")


def _picture(args: Detect, index: int, file: Path) -> Path | None:
    return None if args.pictures is None else args.pictures / f"{index + 1:04d}_{file.name}.png"


def _draw(path: Path, points: np.ndarray, found: Detections, detector: CloudDetector, least: float) -> None:
    from fcos_lidar_jax.visualization.bev import draw_bev

    path.parent.mkdir(parents=True, exist_ok=True)
    limit_m, title = detector.sensor.limit_xy_m, f"{path.stem}: boxes of score {least:g} and more"
    shown = confident(found, least)
    draw_bev(points, path, detections=shown, limit_m=limit_m, classes=detector.classes, title=title)


def _write_results(path: Path, results: Iterable[tuple[str, bytes]]) -> None:
    """A line a file, of which only one is in memory; an entry of the log is a list of one record."""
    with path.open("wb") as file:
        file.write(b'{"files": [')
        for number, (_, entry) in enumerate(results):
            file.write((b",\n" if number else b"\n") + entry[1:-1])
        file.write(b"\n]}\n")


def _write_page(
    args: Detect, clouds: CloudFiles, detector: CloudDetector, results: Iterable[dict[str, Any]]
) -> None:
    """The page, of the files as they are read again, for an interrupted call may have detected in some."""
    assert args.page is not None
    frames = list[PageFrame]()
    for index, result in enumerate(results):
        boxes = np.array([box["box"] for box in result["boxes"]], np.float32).reshape(-1, 9)
        labels = np.array([detector.classes.index(box["label"]) for box in result["boxes"]], np.int32)
        scores = np.array([box["score"] for box in result["boxes"]], np.float32)
        frames.append(
            page_frame(clouds.frame(index).points, (boxes, labels, scores), name=clouds.files[index].name)
        )
    shown: dict[str, Any] = {"min_score": args.min_score} if args.min_score else {}
    write_page(args.page, frames, classes=detector.classes, title=f"Boxes of {args.checkpoint.name}", **shown)
