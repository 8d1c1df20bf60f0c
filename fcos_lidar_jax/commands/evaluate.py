"""``fcos-lidar evaluate``: the benchmark's numbers, without the devkit."""

import dataclasses
import json
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.boxes import GroundTruth
from fcos_lidar_jax.evaluation.detecting import detect_samples
from fcos_lidar_jax.evaluation.examples import choose_examples, sensor_boxes
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.evaluation.results import Results, read_results
from fcos_lidar_jax.evaluation.summary import curve_record, official_summary, write_json
from fcos_lidar_jax.evaluation.truth import read_truth, split_truth
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.snapshots import find_checkpoint
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.metrics import draw_class_curves, write_evaluation_report
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import Picture

_SHOWN_M = 52.0
"""The largest class range, and a little."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate detections as the nuScenes benchmark does, number by number.

    Either a detector is run over a split (--checkpoint), or an official results file is read (--results), against
    the annotations of a data set (--data-root, --version, --split) or a file of ground truth (--ground-truth).
    Writes metrics_summary.json, curves.json, report.html with its pictures, and results_nusc.json. Ctrl-C, or a
    kill, loses one batch of a detector's work: the same command goes on.
    """

    out: Path
    """Folder for the numbers and the report."""
    data_root: Path | None = None
    """Folder with the version's folder, samples/ and sweeps/."""
    version: str | None = None
    """Folder of the tables, such as v1.0-trainval."""
    split: str | None = None
    """Split to evaluate on, such as val."""
    checkpoint: Path | None = None
    """Trained detector to run: a checkpoint, a run, of which the best is taken, or `quickstart`, which comes
    along."""
    results: Path | None = None
    """Official results file to evaluate."""
    ground_truth: Path | None = None
    """Truth as JSON, instead of a data set: {sample token: {"ego_translation", "boxes"}}."""
    index: Path | None = None
    """Index of `prepare`; default: DATA_ROOT/.fcos_lidar/VERSION, or the tables themselves."""
    splits: Path | None = None
    """File {name: [scene, ...]} with own splits; default: the version's splits.json or the official ones."""
    batch_size: int = 1
    """Keyframes on the device at once; does not change the results."""
    bootstrap: int = 0
    """Sets of samples to draw for the 95 % intervals of mAP and NDS; a few hundred will do."""
    report: bool = True
    """Write report.html and its pictures."""
    sensor: str = "nuscenes_hdl32e"
    """Sensor of the range images of a results file: preset or file; a checkpoint knows its own."""
    allow_missing_sweeps: bool = False
    """Go on with fewer sweeps where files of older sweeps are missing."""


def run(args: Evaluate) -> None:
    """Do it, and print the scores."""
    _check(args)
    sensor = load_sensor(args.sensor)
    data: NuScenes | None = None
    if args.ground_truth is not None:
        truth, of = read_truth(args.ground_truth), str(args.ground_truth)
    else:
        assert args.data_root is not None
        assert args.version is not None
        assert args.split is not None
        data = NuScenes(
            args.data_root, args.version, index=args.index, allow_missing_sweeps=args.allow_missing_sweeps
        )
        truth, of = split_truth(data, data.split(args.split, file=args.splits)), f"split {args.split!r}"
    file = args.out / "results_nusc.json"
    if args.checkpoint is not None:
        assert data is not None
        sensor = _detect(args, data, truth.tokens, file)
    results = read_results(args.results or file, truth.tokens, of=of)
    for line in results.warnings:
        print(f"warning: {line}", file=sys.stderr)
    if args.results is not None and not (file.exists() and file.samefile(args.results)):
        write_beside(file, lambda path: shutil.copyfile(args.results or file, path))
    began = time.perf_counter()
    evaluation = evaluate(results.boxes, truth)
    seconds = time.perf_counter() - began
    write_json(
        args.out / "metrics_summary.json", official_summary(evaluation, meta=results.meta, eval_time=seconds)
    )
    write_json(args.out / "curves.json", curve_record(evaluation))
    if args.bootstrap:
        progress = Progress("sets", args.bootstrap)
        drawn = bootstrap(evaluation.rankings, len(truth.tokens), repeats=args.bootstrap, report=progress.show)
        write_json(args.out / "bootstrap.json", drawn)
    else:
        (args.out / "bootstrap.json").unlink(missing_ok=True)
    if args.report:
        _report(args, evaluation, truth, data, sensor)
    _tell(args, evaluation, results, truth)


def _check(args: Evaluate) -> None:
    if (args.checkpoint is None) == (args.results is None):
        raise ValueError("evaluate: expected --checkpoint or --results, one of the two")
    place = (args.data_root, args.version, args.split)
    if args.ground_truth is not None:
        if args.checkpoint is not None:
            raise ValueError("--ground-truth: expected --results with it: a checkpoint needs --data-root")
        if any(option is not None for option in place):
            raise ValueError("--ground-truth: expected neither --data-root, --version nor --split with it")
    elif any(option is None for option in place):
        raise ValueError("evaluate: expected --data-root, --version and --split, or --results with --ground-truth")
    for name, least in (("batch_size", 1), ("bootstrap", 0)):
        if getattr(args, name) < least:
            raise ValueError(f"--{name.replace('_', '-')}: got {getattr(args, name)}, expected at least {least}")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out: {args.out}: found a file, expected a folder")


def _detect(args: Evaluate, data: NuScenes, tokens: tuple[str, ...], file: Path) -> Sensor:
    """Run the detector over the split; returns its sensor."""
    assert args.checkpoint is not None
    checkpoint = load_checkpoint(find_checkpoint(args.checkpoint))
    progress = Progress("keyframes", len(tokens))
    lost = detect_samples(checkpoint, data, tokens, file, batch_size=args.batch_size, report=progress.show)
    if lost:
        print(f"{lost} points of old sweeps found no room in {checkpoint.config.max_points}", file=sys.stderr)
    return checkpoint.sensor


def _tell(args: Evaluate, evaluation: Evaluation, results: Results, truth: GroundTruth) -> None:
    """The scores, and what they must not be mistaken for."""
    summary = evaluation.summary
    absent = [
        name
        for name, ranking in zip(summary["label_aps"], evaluation.rankings, strict=True)
        if not len(ranking.truth_sample)
    ]
    if not len(evaluation.truth):
        print("no ground truth counts here: every AP is 0 and every error 1", file=sys.stderr)
    elif absent:
        print(
            f"no ground truth counts of {', '.join(absent)}: AP 0 and errors 1, as in the benchmark",
            file=sys.stderr,
        )
    if not len(results.boxes):
        print("the results hold not a single box: every AP is 0 and every error 1", file=sys.stderr)
    elif not len(evaluation.predictions):
        print("no box of the results is within the range of its class: every AP is 0", file=sys.stderr)
    print(f"NDS {summary['nd_score']:.4f}  mAP {summary['mean_ap']:.4f}  on {len(truth.tokens)} samples")
    print("  ".join(f"{name} {value:.4f}" for name, value in summary["tp_errors"].items()))
    if args.bootstrap:
        drawn = json.loads((args.out / "bootstrap.json").read_text(encoding="utf-8"))
        spans = (
            f"{n} {drawn[k]['low']:.4f} to {drawn[k]['high']:.4f}"
            for n, k in (("NDS", "nd_score"), ("mAP", "mean_ap"))
        )
        print(f"{drawn['level']:.0%} intervals over samples: {'; '.join(spans)}")
    print(f"look at {args.out / ('report.html' if args.report else 'metrics_summary.json')}")


def _report(
    args: Evaluate, evaluation: Evaluation, truth: GroundTruth, data: NuScenes | None, sensor: Sensor
) -> None:
    """Pictures and the report, whose numbers are read from the files that were written."""
    folder = args.out / "pictures"
    summary, curves = (
        json.loads((args.out / f"{name}.json").read_text(encoding="utf-8"))
        for name in ("metrics_summary", "curves")
    )
    drawn = json.loads((args.out / "bootstrap.json").read_text(encoding="utf-8")) if args.bootstrap else None
    precisions, errors = draw_class_curves(folder, summary, curves)
    views, images = _example_pictures(folder, evaluation, truth, data, sensor)
    subject = args.checkpoint or args.results
    assert subject is not None
    where = f"split {args.split} of {args.version}" if args.ground_truth is None else args.ground_truth.name
    write_evaluation_report(
        args.out / "report.html",
        title=f"{subject.name} on {where}",
        lead=f"The nuScenes detection metrics (detection_cvpr_2019) over {len(truth.tokens)} samples: average "
        "precision (AP) by matching distance, and the mean errors of the hits at 2 m in translation, scale, "
        "orientation, velocity and attribute (ATE, ASE, AOE, AVE, AAE).",
        summary=summary,
        intervals=drawn,
        precisions=precisions,
        errors=errors,
        views=views,
        images=images,
    )


def _example_pictures(
    folder: Path, evaluation: Evaluation, truth: GroundTruth, data: NuScenes | None, sensor: Sensor
) -> tuple[list[Picture], list[Picture]]:
    """The best, a typical and the worst sample from above, and their range images where there are points."""
    chosen = choose_examples(evaluation, len(truth.tokens))
    views: list[Picture] = []
    images: list[Picture] = []
    for name, row in chosen.rows.items():
        token = truth.tokens[row]
        pose, points = np.eye(4), np.zeros((0, 5), np.float32)
        pose[:3, 3] = truth.ego_translation[row]
        if data is not None:
            pose, points = data.sensor_to_global(token), data.sweeps(token, 1)
        found, true = sensor_boxes(evaluation, row, pose, min_score=chosen.min_score)
        caption = f"The {name} sample by hits and misses at 2 m ({token}): detections, truth dashed."
        view, image = folder / f"{name}_bev.png", folder / f"{name}_range.png"
        draw_bev(points, view, limit_m=_SHOWN_M, detections=found, truth=true, global_axes=data is None)
        views.append((caption, view))
        if len(points):
            projected = project_points(points, np.ones(len(points), bool), sensor, num_rounds=1)
            draw_range_image(projected, image, boxes=true[0], detections=found[0])
            images.append((f"The {name} sample's range image: truth above, detections below.", image))
    return views, images
