"""``fcos-lidar evaluate``: how well a detector does, by the benchmark's numbers for nuScenes."""

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli.checks import check_at_least, check_out_file, check_out_folder, check_outside
from fcos_lidar_jax.cli.data import DataOptions, parse_ranges
from fcos_lidar_jax.cli.processes import ProcessOptions, check_processes, join_processes, tell
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation.boxes import BoxColumns, GroundTruth
from fcos_lidar_jax.evaluation.examples import choose_examples, sensor_boxes
from fcos_lidar_jax.evaluation.frames import frame_columns, read_detections, write_detections
from fcos_lidar_jax.evaluation.kitti import describe_kitti
from fcos_lidar_jax.evaluation.kitti_results import KITTI_SUMMARY, write_kitti
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC, Evaluation, Metric, evaluate, metric_of
from fcos_lidar_jax.evaluation.results import read_results, result_entries, write_results
from fcos_lidar_jax.evaluation.summary import describe, warnings, write_evaluation
from fcos_lidar_jax.evaluation.truth import read_truth, split_truth
from fcos_lidar_jax.files import atomic_write, folder_lock
from fcos_lidar_jax.inference import Backend, CloudDetector, load_detector
from fcos_lidar_jax.inference.records import as_records
from fcos_lidar_jax.input_pipeline.open import Layout
from fcos_lidar_jax.presets import NUSCENES_SINGLE
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.trainer.results import write_predictions
from fcos_lidar_jax.training.agreement import agreed
from fcos_lidar_jax.training.preemption import take_sigterm_back
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.evaluation_report import PAGE, Example, clear_report, write_evaluation_report
from fcos_lidar_jax.visualization.page import page_frame, write_page

_DETECTIONS = {True: "results_nusc.json", False: "detections.json"}  # By whether the benchmark's metric is meant.


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate detections: on nuScenes as the benchmark does, number by number; elsewhere, or with a class map, by
    the same average precision and errors over the detector's classes, without NDS.

    Either a detector is run over a split (--checkpoint), or a results file is read (--results), against the
    annotations of a data set (--data-root) or, for an official results file, a file of ground truth
    (--ground-truth). Writes metrics_summary.json, curves.json, report.html with its pictures, frames.html, which
    shows the worst and the best frames with their truth, and the detections: results_nusc.json for nuScenes, else
    detections.json. For KITTI, its own metric is added as metrics_kitti.json, with its result files in
    results_kitti. Ctrl-C, or a kill, loses one batch of a detector's work: the same command resumes.
    """

    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    out: Path  # Folder for the numbers and the report.
    split: str | None = None
    """Split to evaluate on; default: val or mini_val; all frames where the data have no splits."""
    samples: str | None = None
    """FIRST:LAST: frames of the split in their order, LAST excluded; several, separated by commas."""
    checkpoint: Path | None = None
    """Trained detector to run: a checkpoint; a run, which stands for its last one, RUN/best for its best; or
    `hdl32e` or `quickstart`, which come with the package."""
    results: Path | None = None
    """Results file to evaluate: the benchmark's, without a checkpoint; or detections.json, with the one whose
    classes it has."""
    ground_truth: Path | None = None
    """Truth as JSON, instead of a data set: {sample token: {"ego_translation", "boxes"}}."""
    batch_size: int = 1  # Frames that a device takes at once; more than one changes boxes and scores by rounding.
    backend: Backend = "xla"  # What the network runs in, as for `fcos-lidar detect`.
    bootstrap: int = 0  # Sets of samples to draw for the 95 % intervals of mAP and NDS; a few hundred will do.
    report: bool = True  # Write report.html with its pictures, and frames.html.
    sensor: str = "nuscenes_hdl32e"
    """Sensor of the range images of a results file: preset or file; a checkpoint knows its own."""
    processes: tyro.conf.OmitArgPrefixes[ProcessOptions] = dataclasses.field(default_factory=ProcessOptions)
    """Several processes share the detection."""


def run(args: Evaluate) -> None:
    """Detect where a detector is given, evaluate, write, and print the scores."""
    _check(args)
    join_processes(args.processes)
    with contextlib.ExitStack() as locked:
        if args.results is not None:  # nothing is written before the files are read and found good
            compared = _compare(args, _open(args))
            locked.enter_context(folder_lock(args.out, "evaluating"))
            _score(args, compared)
            return
        with agreed("cannot evaluate"):
            task = _open(args)
            is_main_process = jax.process_index() == 0
            if is_main_process:
                locked.enter_context(folder_lock(args.out, "evaluating"))
        _detect(args, task)
        take_sigterm_back()
        with agreed("cannot evaluate"):
            if is_main_process:  # the others wait, for a process that has left would be missed
                _score(args, _compare(args, task))


def _check(args: Evaluate) -> None:
    if args.checkpoint is None and args.results is None:
        raise ValueError("evaluate: expected --checkpoint or --results")
    if args.ground_truth is not None:
        if args.checkpoint is not None:
            raise ValueError("--ground-truth: expected --results with it: a checkpoint needs --data-root")
        if args.data != DataOptions() or args.split is not None or args.samples is not None:
            raise ValueError("--ground-truth: expected no data set with it")
    elif args.data.data_root is None and args.data.format is None:
        raise ValueError("evaluate: expected --data-root, or --results with --ground-truth")
    check_processes(args.processes)
    if args.processes.several and args.results is not None:
        raise ValueError("--results: got several processes, expected one: nothing is detected")
    if args.processes.several and args.backend != "xla":
        raise ValueError(f"--backend: got {args.backend} with several processes, expected xla")
    check_at_least(args, 1, "batch_size")
    check_at_least(args, 0, "bootstrap")
    for name in ("backend", "batch_size"):
        if args.results is not None and (found := getattr(args, name)) != getattr(Evaluate, name):
            option = name.replace("_", "-")
            raise ValueError(f"--{option}: got {found}, expected none with --results: nothing is detected")
    check_out_folder(args.out)
    if args.checkpoint is not None:
        check_outside("--out", args.out, args.checkpoint)
    given = [] if args.results is None else [args.results]
    truth = [] if args.ground_truth is None else [args.ground_truth]
    for name in ("metrics_summary.json", "curves.json", "bootstrap.json", "report.html", PAGE, KITTI_SUMMARY):
        check_out_file("--out", args.out / name, keep=[*given, *truth])
    for name in _DETECTIONS.values():  # may be evaluated again where they are
        check_out_file("--out", args.out / name, keep=truth)


@dataclasses.dataclass(frozen=True)
class _Task:
    """What is evaluated, on what."""

    name: str  # of the truth, for the report
    truth_of: str  # and for messages
    benchmark: bool  # nuScenes' own metric is meant
    sensor: Sensor
    detector: CloudDetector | None
    frames: FrameSet | None  # None for a file of truth, and where the report is to do without points
    truth: GroundTruth | None  # of the benchmark


@dataclasses.dataclass(frozen=True)
class _Compared:
    """Predictions, the truth that they are compared with, and how."""

    task: _Task
    predictions: BoxColumns
    truth: GroundTruth
    metric: Metric
    meta: dict[str, object]
    found: Sequence[Detections] = ()  # the predictions by frame; none by the benchmark's metric


def _open(args: Evaluate) -> _Task:
    """Open the detector and the data; refuse what does not fit together."""
    detector = None if args.checkpoint is None else load_detector(args.checkpoint, backend=args.backend)
    sensor = load_sensor(args.sensor) if detector is None else detector.sensor
    if args.ground_truth is not None:
        truth, file = read_truth(args.ground_truth), args.ground_truth
        return _Task(file.name, str(file), True, sensor, None, None, truth)
    layout = args.data.layout()
    benchmark = _by_the_benchmark(args, layout, detector)
    _check_metric(args, detector, benchmark=benchmark)
    split = args.split or args.data.split("val")
    if args.split is None and split not in (None, "val", "mini_val"):
        line = f"no split val: {split}, the only one, is evaluated, which train takes too"
        tell(f"{layout.root}: {line}; scores of frames that were trained on are too high")
    name = " ".join(filter(None, (str(args.data.data_root or "simulated frames"), layout.version, split)))
    task = _Task(name, name, benchmark, sensor, detector, None, None)
    if benchmark:
        return _with_keyframes(args, task, layout, split)
    assert detector is not None
    frames = args.data.open(detector.config, split=split, samples=args.samples, sensor=sensor)
    if split is None and args.samples is None:
        line = f"no splits: all {len(frames)} frames are evaluated"
        tell(f"{layout.root}: {line}; scores of frames that were trained on are too high")
    return dataclasses.replace(task, frames=frames)


def _check_metric(args: Evaluate, detector: CloudDetector | None, *, benchmark: bool) -> None:
    """Refuse options that do not go with the metric that the data are evaluated by."""
    if benchmark and args.data.class_map is not None:
        raise ValueError("--class-map: expected none with a results file: nuScenes' classes are fixed")
    if benchmark and detector is not None and args.results is not None:
        raise ValueError("--results: got --checkpoint too, expected one of them for nuScenes")
    if not benchmark and detector is None:
        raise ValueError("--results: expected --checkpoint too: its classes are those of detections.json")


def _compare(args: Evaluate, task: _Task) -> _Compared:
    """Read the detections, given or just written, and the truth."""
    file = args.results or args.out / _DETECTIONS[task.benchmark]
    if task.truth is not None:
        results = read_results(file, task.truth.tokens, of=task.truth_of)
        for line in results.warnings:
            tell(f"warning: {line}")
        return _Compared(task, results.boxes, task.truth, NUSCENES_METRIC, results.meta)
    detector, frames = task.detector, task.frames
    assert detector is not None
    assert frames is not None
    names = [frames.name(index) for index in range(len(frames))]
    found = read_detections(file, names, detector.classes)
    predictions, truth = frame_columns(found, (frames.truth(i) for i in range(len(frames))), names)
    metric = metric_of(detector.classes, tuple(detector.config.ranges_m.values()))
    return _Compared(task, predictions, truth, metric, {}, found)


def _score(args: Evaluate, compared: _Compared) -> None:
    """Evaluate, write and print."""
    file, given = args.out / _DETECTIONS[compared.metric.benchmark], args.results
    if given is not None and not (file.exists() and file.samefile(given)):
        atomic_write(file, lambda path: shutil.copyfile(given, path))
    clear_report(args.out)  # of other numbers
    evaluation = evaluate(compared.predictions, compared.truth, compared.metric)
    progress = Progress("sets", args.bootstrap)
    intervals = write_evaluation(args.out, evaluation, compared.meta, repeats=args.bootstrap, report=progress.show)
    for line in warnings(evaluation, len(compared.predictions), compared.truth):
        tell(line)
    print(describe(evaluation, intervals), flush=True)
    if (kitti := write_kitti(args.out, compared.found, compared.task.frames)) is not None:
        print(describe_kitti(kitti), flush=True)
    if args.report:
        _report(args, compared, evaluation)
    print(f"look at {args.out / ('report.html' if args.report else 'metrics_summary.json')}")


def _by_the_benchmark(args: Evaluate, layout: Layout, detector: CloudDetector | None) -> bool:
    """Whether nuScenes' own metric is meant: its data, for a detector of its classes as they are."""
    if layout.format != "nuscenes" or detector is None:
        return layout.format == "nuscenes"
    return set(detector.classes) <= set(NUSCENES_CLASSES) and args.data.class_map is None


def _with_keyframes(args: Evaluate, task: _Task, layout: Layout, split: str | None) -> _Task:
    """The task with the keyframes of nuScenes and their truth."""
    allowed = {name: getattr(args.data, name) for name in ("allow_missing_sweeps", "follow_links")}
    data = NuScenes(layout.root, str(layout.version), index=args.data.index, **allowed)
    tokens = data.sample_tokens if split is None else data.split(split, file=args.data.splits)
    if args.samples is not None:
        tokens = [tokens[i] for i in parse_ranges(args.samples, len(tokens))]
    config = NUSCENES_SINGLE if task.detector is None else task.detector.config
    close = config.projection.remove_close, config.projection.close_m
    frames = NuScenesFrames(data, tuple(tokens), config.num_sweeps, *close, task.sensor)
    task = dataclasses.replace(task, truth=split_truth(data, tokens), frames=frames)
    if task.detector is not None and (missing := data.missing_sweeps(tokens, config.num_sweeps)):
        tell(f"{missing} sweep files of split {split!r} are missing")
    # A results file is evaluated with the tables alone.
    if task.detector is None and args.report and (missing := data.missing_sweeps(tokens, 1)):
        tell(f"{missing} files of keyframes are missing: the report shows boxes without points")
        return dataclasses.replace(task, frames=None)
    return task


def _detect(args: Evaluate, task: _Task) -> None:
    """Write the detections, and report what was removed of the points but for those on the ego vehicle."""
    detector, frames = task.detector, task.frames
    assert detector is not None
    assert frames is not None

    def entries(index: int, found: Detections) -> list[dict[str, Any]]:
        if not isinstance(frames, NuScenesFrames):
            return as_records(found, detector.classes)
        token = frames.tokens[index]
        return result_entries(found, token, frames.nuscenes.sensor_to_global(token), detector.classes)

    write = write_results if task.benchmark else partial(write_detections, classes=detector.classes)
    file, batch = args.out / _DETECTIONS[task.benchmark], {"batch_size": args.batch_size}
    removed = write_predictions(detector, frames, file, entries=entries, write=write, **batch)
    if removed["truncated"]:
        tell(f"{removed['truncated']} points truncated: more than the detector's max_points")
    if removed["invalid"]:
        tell(f"{removed['invalid']} points dropped: not finite, or beyond physical limits")


def _report(args: Evaluate, compared: _Compared, evaluation: Evaluation) -> None:
    """The report, and the page that it links to."""
    task = compared.task
    title = f"{(args.checkpoint or args.results or Path()).name} on {task.name}"
    chosen = choose_examples(evaluation)
    place = evaluation, task.frames, compared.truth.ego_translation
    frames = [
        page_frame(each.points, each.detections, name=f"{each.kind}: {each.name}", truth=each.truth)
        for each in examples(*place, chosen.extremes, min_score=0, all_sweeps=True)
    ]
    if frames:
        options = {"classes": evaluation.metric.classes, "min_score": chosen.min_score}
        write_page(args.out / PAGE, frames, title=title, **options)
    write_evaluation_report(
        args.out,
        title=title,
        num_samples=len(compared.truth.tokens),
        examples=examples(*place, chosen.rows, min_score=chosen.min_score),
        sensor=task.sensor,
        links=[("Look at the worst and the best frames", PAGE)] if frames else [],
    )


def examples(
    evaluation: Evaluation,
    frames: FrameSet | None,
    centres: np.ndarray,
    rows: Mapping[str, int],
    *,
    min_score: float,
    all_sweeps: bool = False,
) -> Iterator[Example]:
    """Samples by what they are called, with the boxes that reach a score, and the current sweep or all of them.

    Without frames they are in the global frame, around their ``centres`` f64[samples, 3], and without points.
    """
    for kind, row in rows.items():
        pose, points = np.eye(4), np.zeros((0, 5), np.float32)
        pose[:3, 3] = centres[row]
        if frames is not None:
            points = frames.frame(row).points
            points = points if all_sweeps else points[points[:, 4] == 0]
            own_pose = frames.pose(row) if evaluation.metric is NUSCENES_METRIC else None
            pose = np.eye(4) if own_pose is None else own_pose
        found, true = sensor_boxes(evaluation, row, pose, min_score=min_score)
        yield Example(kind, evaluation.tokens[row], points, found, true)
