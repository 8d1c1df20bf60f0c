"""``fcos-lidar evaluate``: detection metrics, for nuScenes those of the official benchmark."""

import contextlib
import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import jax
import tyro

from fcos_lidar_jax.checkpoints.preemption import take_sigterm_back
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli import options
from fcos_lidar_jax.cli.checks import (
    check_at_least,
    check_out_file,
    check_out_folder,
    check_outside,
    option_name,
)
from fcos_lidar_jax.cli.data import DataOptions, parse_ranges
from fcos_lidar_jax.cli.options import DETECTOR_TEXT, option
from fcos_lidar_jax.cli.processes import ProcessOptions, check_processes, join_processes, tell
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.devices.agreement import agreed
from fcos_lidar_jax.evaluation.comparison import (
    RESULT_FILES,
    Compared,
    Comparison,
    compare_by_benchmark,
    compare_by_distance,
)
from fcos_lidar_jax.evaluation.examples import choose_examples
from fcos_lidar_jax.evaluation.kitti import describe_kitti
from fcos_lidar_jax.evaluation.kitti_results import KITTI_SUMMARY, write_kitti
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.evaluation.summary import describe, warnings, write_evaluation
from fcos_lidar_jax.evaluation.truth import read_truth
from fcos_lidar_jax.files import atomic_write, folder_lock
from fcos_lidar_jax.inference import CloudDetector, load_detector
from fcos_lidar_jax.inference.prediction_log import write_predictions
from fcos_lidar_jax.presets import NUSCENES_SINGLE
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.visualization.evaluation_report import (
    PAGE,
    clear_report,
    make_examples,
    write_evaluation_report,
)
from fcos_lidar_jax.visualization.page import page_frame, write_page
from fcos_lidar_jax.visualization.report import Picture


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate detections: on nuScenes with the official metric, on other data or with a class map with the same
    average precision and errors over the detector's classes, without NDS.

    The detections come from a detector that is run over a split (--checkpoint) or from a file (--results). The
    truth comes from a data set (--data-root) or, for an official results file, from a file (--ground-truth). The
    command writes metrics_summary.json, curves.json, report.html, frames.html, which shows the worst and the best
    frames, and the detections: results_nusc.json for nuScenes, otherwise detections.json. For KITTI it adds the
    benchmark's own metric, metrics_kitti.json, and its result files, results_kitti. After Ctrl-C or a kill, the
    same command resumes and repeats at most one batch.
    """

    data: tyro.conf.OmitArgPrefixes[DataOptions]  # The data set.
    out: Annotated[Path, option("DIR")]  # Folder for the metrics and the report.
    split: Annotated[str | None, option("SPLIT", default="val, mini_val, or all frames without splits")] = None
    """Split to evaluate on."""
    samples: Annotated[str | None, option("FIRST:LAST,...", default="all")] = None
    """Ranges of the split's frames, LAST excluded."""
    checkpoint: Annotated[Path | None, option("C", text=DETECTOR_TEXT)] = None
    results: Annotated[Path | None, option("FILE")] = None
    """Results to evaluate: an official results file, or detections.json with the --checkpoint it came from."""
    ground_truth: Annotated[Path | None, option("FILE")] = None
    """Truth instead of a data set: {sample token: {"ego_translation", "boxes"}}."""
    batch_size: options.BatchSize = 1
    backend: options.Backend = "xla"
    bootstrap: Annotated[int, option("N")] = 0
    """Resampled sets for the 95 % intervals of mAP and NDS, such as 200; 0 for no intervals."""
    report: bool = True  # Write report.html with its pictures, and frames.html.
    sensor: Annotated[str, option("SENSOR")] = "nuscenes_hdl32e"
    """Sensor preset or sensor file of the report's range images, without a --checkpoint."""
    processes: tyro.conf.OmitArgPrefixes[ProcessOptions] = dataclasses.field(default_factory=ProcessOptions)
    """Share the detection among several processes."""


Draw = Callable[[Evaluation, FrameSet, float], tuple[list[Picture], list[tuple[str, str]]]]
"""Evaluation, its frames and the threshold of the shown scores -> more pictures and links for the report."""


def run(args: Evaluate, *, title: str | None = None, draw: Draw | None = None) -> None:
    """Detect if a detector is given, evaluate, write, and print the scores.

    Args:
        args: the options.
        title: of the report; by default the detector or the results, and the data.
        draw: draws more for the report.
    """
    _check(args)
    join_processes(args.processes)
    is_main_process = jax.process_index() == 0
    with contextlib.ExitStack() as locked:
        with agreed("cannot evaluate"):
            task = _open(args)
            # Given files are read and checked before anything is written.
            compared = None if args.results is None else task.comparison.read(args.results)
            if is_main_process:
                locked.enter_context(folder_lock(args.out, "evaluating"))
        if compared is None:
            _detect(args, task)
            take_sigterm_back()
        with agreed("cannot evaluate"):
            if is_main_process:  # the others wait, because the first one would report their exit
                compared = compared or task.comparison.read(args.out / task.comparison.file)
                evaluation = _score(args, task, compared)
                if args.report:
                    _report(args, task, compared, evaluation, title, draw)
                print(f"look at {args.out / ('report.html' if args.report else 'metrics_summary.json')}")


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
        raise ValueError("--results: got several processes, expected one, since nothing is detected")
    if args.processes.several and args.backend != "xla":
        raise ValueError(f"--backend: got {args.backend} with several processes, expected xla")
    check_at_least(args, 1, "batch_size")
    check_at_least(args, 0, "bootstrap")
    for name in ("backend", "batch_size"):
        if args.results is not None and (value := getattr(args, name)) != getattr(Evaluate, name):
            raise ValueError(
                f"{option_name(name)}: got {value}, expected none with --results, since nothing is detected"
            )
    check_out_folder(args.out)
    if args.checkpoint is not None:
        check_outside("--out", args.out, args.checkpoint)
    inputs = [file for file in (args.results, args.ground_truth) if file is not None]
    for name in ("metrics_summary.json", "curves.json", "bootstrap.json", "report.html", PAGE, KITTI_SUMMARY):
        check_out_file("--out", args.out / name, keep=inputs)
    for name in RESULT_FILES:  # --results may be in the folder already
        check_out_file("--out", args.out / name, keep=[file for file in inputs if file is not args.results])


@dataclasses.dataclass(frozen=True)
class _Task:
    name: str  # of the truth, for the report
    comparison: Comparison
    sensor: Sensor
    detector: CloudDetector | None = None
    frames: FrameSet | None = None  # None if the report has no points


def _open(args: Evaluate) -> _Task:
    """Open the detector and the data, and check that they fit together."""
    detector = None if args.checkpoint is None else load_detector(args.checkpoint, backend=args.backend)
    config = NUSCENES_SINGLE if detector is None else detector.config
    sensor = load_sensor(args.sensor) if detector is None else detector.sensor
    if args.ground_truth is not None:
        comparison = compare_by_benchmark(read_truth(args.ground_truth), str(args.ground_truth))
        return _Task(args.ground_truth.name, comparison, sensor)
    data = args.data.find()
    official = detector is None or (set(detector.classes) <= set(NUSCENES_CLASSES) and args.data.class_map is None)
    benchmark = data.tables is not None and official
    _check_metric(args, detector, benchmark=benchmark)
    split = args.split or args.data.split("val")
    too_high = "scores on training frames are too high"
    if args.split is None and split not in (None, "val", "mini_val"):
        tell(f"{data.root}: no split val: evaluating {split}, the only split, which train uses too; {too_high}")
    name = " ".join(filter(None, (str(args.data.data_root or "simulated frames"), data.version, split)))
    if not benchmark:
        frames = args.data.open(config, split=split, samples=args.samples, sensor=sensor)
        if split is None and args.samples is None:
            tell(f"{data.root}: no splits: evaluating all {len(frames)} frames; {too_high}")
        return _Task(name, compare_by_distance(frames, config.ranges_m), sensor, detector, frames)
    frames = args.data.open_whole(split, config.reading, sensor, report_missing=detector is not None)
    assert isinstance(frames, NuScenesFrames)
    if args.samples is not None:
        tokens = tuple(frames.tokens[i] for i in parse_ranges(args.samples, len(frames)))
        frames = dataclasses.replace(frames, tokens=tokens)
    comparison = compare_by_benchmark(frames, name, config.classes)
    # Evaluating a results file needs only the tables.
    if detector is None and args.report and (missing := frames.nuscenes.missing_sweeps(list(frames.tokens), 1)):
        tell(f"{missing} files of keyframes are missing: the report shows boxes without points")
        return _Task(name, comparison, sensor)
    return _Task(name, comparison, sensor, detector, frames)


def _check_metric(args: Evaluate, detector: CloudDetector | None, *, benchmark: bool) -> None:
    """Reject options that do not fit the metric."""
    if benchmark and args.data.class_map is not None:
        raise ValueError("--class-map: expected none with a results file, since the classes of nuScenes are fixed")
    if benchmark and detector is not None and args.results is not None:
        raise ValueError("--results: got --checkpoint too, expected one of them for nuScenes")
    if not benchmark and detector is None:
        raise ValueError("--results: expected --checkpoint too, for the classes of detections.json")


def _detect(args: Evaluate, task: _Task) -> None:
    """Write the detections, and count the removed points, except for close ones."""
    assert task.detector is not None
    assert task.frames is not None
    comparison = task.comparison
    removed = write_predictions(
        task.detector,
        task.frames,
        args.out / comparison.file,
        entries=comparison.entries,
        write=comparison.write,
        batch_size=args.batch_size,
    )
    if removed["truncated"]:
        tell(f"{removed['truncated']} points truncated: more than the detector's max_points")
    if removed["invalid"]:
        tell(f"{removed['invalid']} points dropped: not finite, or beyond physical limits")


def _score(args: Evaluate, task: _Task, compared: Compared) -> Evaluation:
    for line in compared.warnings:
        tell(f"warning: {line}")
    file, given = args.out / task.comparison.file, args.results
    if given is not None and not (file.exists() and file.samefile(given)):
        atomic_write(file, lambda path: shutil.copyfile(given, path))
    clear_report(args.out)  # it may show other numbers
    evaluation = evaluate(compared.predictions, compared.truth, task.comparison.metric)
    progress = Progress("sets", args.bootstrap)
    intervals = write_evaluation(args.out, evaluation, compared.meta, repeats=args.bootstrap, report=progress.show)
    for line in warnings(evaluation, len(compared.predictions), compared.truth):
        tell(line)
    print(describe(evaluation, intervals), flush=True)
    if (kitti := write_kitti(args.out, compared.detections, task.frames)) is not None:
        print(describe_kitti(kitti), flush=True)
    return evaluation


def _report(
    args: Evaluate, task: _Task, compared: Compared, evaluation: Evaluation, title: str | None, draw: Draw | None
) -> None:
    """Write the report and the page that it links to."""
    title = title or f"{(args.checkpoint or args.results or Path()).name} on {task.name}"
    examples = choose_examples(evaluation)
    source = evaluation, task.frames, compared.truth.ego_translation
    frames = [
        page_frame(each.points, each.detections, name=f"{each.kind}: {each.name}", truth=each.truth)
        for each in make_examples(*source, examples.extremes, min_score=0, all_sweeps=True)
    ]
    if frames:
        options = {"classes": evaluation.metric.classes, "min_score": examples.min_score}
        write_page(args.out / PAGE, frames, title=title, **options)
    pictures, links = draw(evaluation, task.frames, examples.min_score) if draw and task.frames else ([], [])
    write_evaluation_report(
        args.out,
        title=title,
        num_samples=len(compared.truth.tokens),
        examples=make_examples(*source, examples.rows, min_score=examples.min_score),
        sensor=task.sensor,
        pictures=pictures,
        links=links + ([("Look at the worst and the best frames", PAGE)] if frames else []),
    )
