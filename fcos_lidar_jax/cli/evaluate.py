"""``fcos-lidar evaluate``: detection metrics; for nuScenes, the official ones."""

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Annotated

import jax
import tyro

from fcos_lidar_jax.checkpoints.preemption import take_sigterm_back
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import Excludes, Or, Output, check_out_file, exit_without, option_name
from fcos_lidar_jax.cli.data import DataOptions, parse_ranges
from fcos_lidar_jax.cli.options import DETECTOR_TEXT, option, radians
from fcos_lidar_jax.cli.processes import ProcessOptions, join_processes
from fcos_lidar_jax.cli.scoring import Task, run_detector, write_recording, write_reports, write_scores
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.kitti import KittiFrames, cropped
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.devices.agreement import agreed
from fcos_lidar_jax.evaluation.comparison import RESULT_FILES, compare_by_benchmark, compare_by_distance
from fcos_lidar_jax.evaluation.kitti import describe_kitti
from fcos_lidar_jax.evaluation.kitti_results import KITTI_SUMMARY, score_kitti
from fcos_lidar_jax.evaluation.truth import read_truth, split_truth
from fcos_lidar_jax.fields import Natural
from fcos_lidar_jax.files import atomic_write, folder_lock
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.inference.alignment import heading, other_rows
from fcos_lidar_jax.presets import NUSCENES_SINGLE
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.visualization.evaluation_report import PAGE, clear_report

_TOO_HIGH = "scores on training frames are too high"
_NO_DETECTION = Excludes(("backend", "batch_size", "yaw_deg", "distributed", "coordinator"), "nothing is detected")
_NO_DATA = Excludes(
    ("checkpoint", "split", "samples", *(field.name for field in dataclasses.fields(DataOptions))),
    "it takes the place of a data set",
)
_ONE_PROCESS = Excludes(("distributed", "coordinator"), "only xla runs in several processes")
_WRITTEN = ("metrics_summary.json", "curves.json", "bootstrap.json", "report.html", PAGE, KITTI_SUMMARY)


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate a detector or a results file: compute metrics and write a report.

    On nuScenes, the metric is the official one. On other data, and with a class map, it is the same average
    precision and errors over the detector's classes, without NDS. For KITTI, the command adds the benchmark's own
    metric.

    Give a detector with --checkpoint, or a file of detections with --results. The ground truth comes from a data
    set (--data-root) or, for an official results file, from a file (--ground-truth). For a folder of KITTI result
    files, only KITTI's metric is computed.

    The command writes metrics_summary.json, curves.json, report.html, frames.html (the worst and the best frames),
    and the detections: results_nusc.json for nuScenes, otherwise detections.json. For KITTI, it also writes
    metrics_kitti.json and result files in results_kitti. After Ctrl-C or a kill, the same command resumes
    the detection and repeats at most one batch, and clouds without usable points. To evaluate finished
    detections again, use --results.
    """

    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    out: Annotated[Path, Output.FOLDER, option("DIR")]  # Folder for the metrics and the report.
    split: Annotated[str | None, option("SPLIT", default="val, mini_val, or all frames without splits")] = None
    """Split to evaluate on."""
    samples: Annotated[str | None, option("FIRST:LAST,...", default="all")] = None
    """Ranges of the split's frames, LAST excluded."""
    checkpoint: Annotated[
        Path | None, Or("results"), option("C", default="none, with --results", text=DETECTOR_TEXT)
    ] = None
    results: Annotated[Path | None, _NO_DETECTION, option("FILE|DIR")] = None
    """Results to evaluate: an official results file, detections.json with the --checkpoint it came from,
    or a folder of KITTI result files, one for each frame of the split."""
    ground_truth: Annotated[Path | None, _NO_DATA, option("FILE")] = None
    """Ground truth instead of a data set: {sample token: {"ego_translation", "boxes"}}."""
    yaw_deg: options.Yaw = None
    batch_size: options.BatchSize = 1
    backend: Annotated[options.Backend, _ONE_PROCESS] = "xla"
    bootstrap: Annotated[Natural, option("N")] = 0
    """Bootstrap samples for the 95 % intervals of mAP and NDS, such as 200; 0 for no intervals."""
    report: bool = True  # Write report.html with its pictures, and frames.html.
    rrd: Annotated[options.Rrd, Excludes(("ground_truth",), "it has no points")] = None
    sensor: Annotated[str, Excludes(("checkpoint",), "its sensor is used"), option("SENSOR")] = "nuscenes_hdl32e"
    """Without --checkpoint: sensor preset or sensor file for the range images of the report."""
    processes: tyro.conf.OmitArgPrefixes[ProcessOptions] = dataclasses.field(default_factory=ProcessOptions)
    """Share the detection among several processes."""


def run(args: Evaluate) -> None:
    """Detect if a detector is given, evaluate, write, and print the scores."""
    if args.results and not (args.ground_truth or args.data.data_root or args.data.format):
        exit_without("--data-root", "--ground-truth")
    _check_written(args)
    is_folder = args.results is not None and args.results.is_dir() and args.ground_truth is None
    if is_folder and args.data.data_set.reader.result_folders:
        return _score_kitti_results(args)
    join_processes(args.processes)
    is_main_process = jax.process_index() == 0
    with contextlib.ExitStack() as locked:
        with agreed("cannot evaluate"):
            task = _open(args)
            results = args.out / task.comparison.file
            # Given files are read and checked before anything is written.
            compared = None if args.results is None else task.comparison.read(args.results)
            if is_main_process:
                locked.enter_context(folder_lock(args.out, "evaluating"))
        if compared is None:
            run_detector(task, args.out, batch_size=args.batch_size, yaw_rad=radians(args.yaw_deg))
            take_sigterm_back()
        with agreed("cannot evaluate"):
            if is_main_process:  # the others wait, because the first one would report their exit
                compared = compared or task.comparison.read(results)
                if (given := args.results) is not None and not (results.exists() and results.samefile(given)):
                    atomic_write(results, lambda path: shutil.copyfile(given, path))
                evaluation = write_scores(task, compared, args.out, bootstrap=args.bootstrap)
                if args.rrd is not None:
                    write_recording(task, evaluation, args.rrd)
                if args.report:
                    title = f"{(args.checkpoint or args.results or Path()).name} on {task.name}"
                    write_reports(task, compared, evaluation, args.out, title=title)
                print(f"look at {args.out / ('report.html' if args.report else 'metrics_summary.json')}")


def _check_written(args: Evaluate) -> None:
    """Reject a folder in which a file would replace an input. The results may be in it already."""
    for name in (*_WRITTEN, *RESULT_FILES):
        inputs = args.ground_truth, None if name in RESULT_FILES else args.results
        check_out_file("--out", args.out / name, keep=[file for file in inputs if file is not None])


def _score_kitti_results(args: Evaluate) -> None:
    """Compute KITTI's metric of a folder of result files."""
    assert args.results is not None
    data = DataOptions(args.data.data_root, args.data.format, splits=args.data.splits)
    used = {name: getattr(args, name) for name in ("out", "split", "results", "report", "processes")}
    for given, usual in ((args.data, data), (args, Evaluate(data, **used))):
        for name in (field.name for field in dataclasses.fields(given) if field.name != "data"):
            if (value := getattr(given, name)) != getattr(usual, name):
                raise ValueError(f"{option_name(name)}: got {value}, expected none with a folder of results")
    split = _split(args.data, args.split)
    frames = args.data.open_whole(split, CloudReading())
    assert isinstance(frames, KittiFrames)
    metrics = score_kitti(args.results, frames, of=f"split {split!r}" if split else str(frames.root))
    with folder_lock(args.out, "evaluating"):
        clear_report(args.out)  # it may show other numbers
        atomic_write(args.out / KITTI_SUMMARY, json.dumps(metrics, indent=2))
    print(describe_kitti(metrics))
    print(f"look at {args.out / KITTI_SUMMARY}")


def _open(args: Evaluate) -> Task:
    """Open the detector and the truth."""
    detector = None if args.checkpoint is None else load_detector(args.checkpoint, backend=args.backend)
    sensor = load_sensor(args.sensor) if detector is None else detector.sensor
    if args.ground_truth is not None:
        comparison = compare_by_benchmark(read_truth(args.ground_truth), str(args.ground_truth))
        return Task(args.ground_truth.name, comparison, sensor)
    data = args.data.data_set
    if data.tables is None:
        args.data.refuse_index("only the tables of nuScenes have an index")
    has_benchmark = data.tables is not None and args.data.class_map is None
    if detector is None and not has_benchmark:
        expected = "--checkpoint too, for the classes of detections.json, or a folder of KITTI's result files"
        raise ValueError(f"--results: {args.results}: expected {expected}")
    split = _split(args.data, args.split)
    name = " ".join(filter(None, (str(args.data.data_root or "simulated frames"), data.version, split)))
    if detector is None or (has_benchmark and set(detector.classes) <= set(NUSCENES_CLASSES)):
        if detector is not None and args.results is not None:
            raise ValueError("--results: got --checkpoint too, expected one of them for nuScenes")
        config = NUSCENES_SINGLE if detector is None else detector.config
        frames = args.data.open_whole(split, config.reading, sensor, report_missing=detector is not None)
        assert isinstance(frames, NuScenesFrames)
        if args.samples is not None:
            tokens = tuple(frames.tokens[i] for i in parse_ranges(args.samples, len(frames)))
            frames = dataclasses.replace(frames, tokens=tokens)
        comparison = compare_by_benchmark(
            split_truth(frames.nuscenes, frames.tokens), name, config.classes, frames
        )
        # Evaluating a results file needs only the tables.
        only_boxes = detector is None and args.report and args.rrd is None
        if only_boxes and (missing := frames.nuscenes.missing_sweeps(list(frames.tokens), 1)):
            tell(f"{missing} files of keyframes are missing: the report shows boxes without points")
            return Task(name, comparison, sensor)
        return Task(name, comparison, frames.sensor, detector, frames)
    frames = args.data.open(detector.config, split=split, samples=args.samples, sensor=sensor)
    if split is None and args.samples is None:
        tell(f"{data.root}: no splits: evaluating all {len(frames)} frames; {_TOO_HIGH}")
    return _compare_frames(name, frames, detector, args.data, radians(args.yaw_deg))


def _compare_frames(
    name: str, frames: MappedFrames, detector: CloudDetector, options: DataOptions, yaw_rad: float | None
) -> Task:
    """Data without a benchmark, whose damaged files are named now, and not after the detector was compiled."""
    data, own = options.data_set, frames.sensor  # the report's range images are in the frame of the data
    if data.on_disk:
        for index in range(len(frames)):
            frames.labels(index)
            frames.camera(index)  # reads the calibration of KITTI
    if data.reader.sensor is None and yaw_rad is not None:
        own = dataclasses.replace(own, forward_rad=heading(detector.sensor, yaw_rad))
    # Only own data tell the number of rows: the frames of other formats have the rows of the detector's.
    notes = () if data.reader.sensor else other_rows(frames.sensor, detector.sensor)
    if "full_turn" in data.reader.options:
        unlabelled = "detections outside the camera image, where KITTI has no labels, lower mAP by distance"
        notes += (unlabelled if options.full_turn else cropped(data.root),)
    comparison = compare_by_distance(frames, detector.config.ranges_m)
    return Task(name, comparison, own, detector, frames, notes)


def _split(options: DataOptions, given: str | None) -> str | None:
    """The given split or the default, with a note if that is not a validation split."""
    split = options.split("val", given)
    if given is None and split not in (None, "val", "mini_val"):
        only = f"no split val: evaluating {split}, the only split, which train uses too"
        tell(f"{options.data_set.root}: {only}; {_TOO_HIGH}")
    return split
