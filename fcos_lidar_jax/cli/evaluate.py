"""``fcos-lidar evaluate``: how well a detector does, by the benchmark's numbers for nuScenes."""

import contextlib
import dataclasses
import shutil
from pathlib import Path

import jax
import tyro

from fcos_lidar_jax.checkpoints.preemption import take_sigterm_back
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.cli.checks import check_at_least, check_out_file, check_out_folder, check_outside
from fcos_lidar_jax.cli.data import DataOptions, parse_ranges
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
from fcos_lidar_jax.inference import Backend, CloudDetector, load_detector
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
    is_main_process = jax.process_index() == 0
    with contextlib.ExitStack() as locked:
        with agreed("cannot evaluate"):
            task = _open(args)
            # Nothing is written before files that are given are read and found good.
            compared = None if args.results is None else task.comparison.read(args.results)
            if is_main_process:
                locked.enter_context(folder_lock(args.out, "evaluating"))
        if compared is None:
            _detect(args, task)
            take_sigterm_back()
        with agreed("cannot evaluate"):
            if is_main_process:  # the others wait, for a process that has left would be missed
                _score(args, task, compared or task.comparison.read(args.out / task.comparison.file))


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
        if args.results is not None and (value := getattr(args, name)) != getattr(Evaluate, name):
            option = name.replace("_", "-")
            raise ValueError(f"--{option}: got {value}, expected none with --results: nothing is detected")
    check_out_folder(args.out)
    if args.checkpoint is not None:
        check_outside("--out", args.out, args.checkpoint)
    given = [] if args.results is None else [args.results]
    truth = [] if args.ground_truth is None else [args.ground_truth]
    for name in ("metrics_summary.json", "curves.json", "bootstrap.json", "report.html", PAGE, KITTI_SUMMARY):
        check_out_file("--out", args.out / name, keep=[*given, *truth])
    for name in RESULT_FILES:  # may be evaluated again where they are
        check_out_file("--out", args.out / name, keep=truth)


@dataclasses.dataclass(frozen=True)
class _Task:
    """What is evaluated, on what."""

    name: str  # of the truth, for the report
    comparison: Comparison
    sensor: Sensor
    detector: CloudDetector | None = None
    frames: FrameSet | None = None  # None for a file of truth, and where the report is to do without points


def _open(args: Evaluate) -> _Task:
    """Open the detector and the data; refuse what does not fit together."""
    detector = None if args.checkpoint is None else load_detector(args.checkpoint, backend=args.backend)
    config = NUSCENES_SINGLE if detector is None else detector.config
    sensor = load_sensor(args.sensor) if detector is None else detector.sensor
    if args.ground_truth is not None:
        comparison = compare_by_benchmark(read_truth(args.ground_truth), str(args.ground_truth))
        return _Task(args.ground_truth.name, comparison, sensor)
    data = args.data.find()
    known = detector is None or (set(detector.classes) <= set(NUSCENES_CLASSES) and args.data.class_map is None)
    benchmark = data.tables is not None and known
    _check_metric(args, detector, benchmark=benchmark)
    split = args.split or args.data.split("val")
    too_high = "scores of frames that were trained on are too high"
    if args.split is None and split not in (None, "val", "mini_val"):
        tell(f"{data.root}: no split val: {split}, the only one, is evaluated, which train takes too; {too_high}")
    name = " ".join(filter(None, (str(args.data.data_root or "simulated frames"), data.version, split)))
    if not benchmark:
        frames = args.data.open(config, split=split, samples=args.samples, sensor=sensor)
        if split is None and args.samples is None:
            tell(f"{data.root}: no splits: all {len(frames)} frames are evaluated; {too_high}")
        return _Task(name, compare_by_distance(frames, config.ranges_m), sensor, detector, frames)
    frames = args.data.open_whole(split, config.reading, sensor, missing=detector is not None)
    assert isinstance(frames, NuScenesFrames)
    if args.samples is not None:
        tokens = tuple(frames.tokens[i] for i in parse_ranges(args.samples, len(frames)))
        frames = dataclasses.replace(frames, tokens=tokens)
    comparison = compare_by_benchmark(frames, name, config.classes)
    # A results file is evaluated with the tables only.
    if detector is None and args.report and (missing := frames.nuscenes.missing_sweeps(list(frames.tokens), 1)):
        tell(f"{missing} files of keyframes are missing: the report shows boxes without points")
        return _Task(name, comparison, sensor)
    return _Task(name, comparison, sensor, detector, frames)


def _check_metric(args: Evaluate, detector: CloudDetector | None, *, benchmark: bool) -> None:
    """Refuse options that do not go with the metric that the data are evaluated by."""
    if benchmark and args.data.class_map is not None:
        raise ValueError("--class-map: expected none with a results file: nuScenes' classes are fixed")
    if benchmark and detector is not None and args.results is not None:
        raise ValueError("--results: got --checkpoint too, expected one of them for nuScenes")
    if not benchmark and detector is None:
        raise ValueError("--results: expected --checkpoint too: its classes are those of detections.json")


def _detect(args: Evaluate, task: _Task) -> None:
    """Write the detections, and report the points that were removed, apart from those on the ego vehicle."""
    assert task.detector is not None
    assert task.frames is not None
    file, form = args.out / task.comparison.file, task.comparison
    how = {"entries": form.entries, "write": form.write, "batch_size": args.batch_size}
    removed = write_predictions(task.detector, task.frames, file, **how)
    if removed["truncated"]:
        tell(f"{removed['truncated']} points truncated: more than the detector's max_points")
    if removed["invalid"]:
        tell(f"{removed['invalid']} points dropped: not finite, or beyond physical limits")


def _score(args: Evaluate, task: _Task, compared: Compared) -> None:
    """Evaluate, write and print."""
    for line in compared.warnings:
        tell(f"warning: {line}")
    file, given = args.out / task.comparison.file, args.results
    if given is not None and not (file.exists() and file.samefile(given)):
        atomic_write(file, lambda path: shutil.copyfile(given, path))
    clear_report(args.out)  # of other numbers
    evaluation = evaluate(compared.predictions, compared.truth, task.comparison.metric)
    progress = Progress("sets", args.bootstrap)
    intervals = write_evaluation(args.out, evaluation, compared.meta, repeats=args.bootstrap, report=progress.show)
    for line in warnings(evaluation, len(compared.predictions), compared.truth):
        tell(line)
    print(describe(evaluation, intervals), flush=True)
    if (kitti := write_kitti(args.out, compared.detections, task.frames)) is not None:
        print(describe_kitti(kitti), flush=True)
    if args.report:
        _report(args, task, compared, evaluation)
    print(f"look at {args.out / ('report.html' if args.report else 'metrics_summary.json')}")


def _report(args: Evaluate, task: _Task, compared: Compared, evaluation: Evaluation) -> None:
    """The report, and the page that it links to."""
    title = f"{(args.checkpoint or args.results or Path()).name} on {task.name}"
    chosen = choose_examples(evaluation)
    place = evaluation, task.frames, compared.truth.ego_translation
    frames = [
        page_frame(each.points, each.detections, name=f"{each.kind}: {each.name}", truth=each.truth)
        for each in make_examples(*place, chosen.extremes, min_score=0, all_sweeps=True)
    ]
    if frames:
        options = {"classes": evaluation.metric.classes, "min_score": chosen.min_score}
        write_page(args.out / PAGE, frames, title=title, **options)
    write_evaluation_report(
        args.out,
        title=title,
        num_samples=len(compared.truth.tokens),
        examples=make_examples(*place, chosen.rows, min_score=chosen.min_score),
        sensor=task.sensor,
        links=[("Look at the worst and the best frames", PAGE)] if frames else [],
    )
