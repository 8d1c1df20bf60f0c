"""Detection, scores and reports on a data set, for the commands ``evaluate`` and ``demo``."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.cloud_policy import truncation
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.evaluation.comparison import Compared, Comparison
from fcos_lidar_jax.evaluation.examples import choose_examples
from fcos_lidar_jax.evaluation.kitti import describe_kitti
from fcos_lidar_jax.evaluation.kitti_results import KITTI_SUMMARY, write_kitti
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE
from fcos_lidar_jax.evaluation.summary import describe, warnings, write_evaluation
from fcos_lidar_jax.inference import CloudDetector
from fcos_lidar_jax.inference.prediction_log import write_predictions
from fcos_lidar_jax.progress import Progress, tell
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.visualization.evaluation_report import (
    PAGE,
    clear_report,
    make_examples,
    write_evaluation_report,
)
from fcos_lidar_jax.visualization.page import page_frame, write_page
from fcos_lidar_jax.visualization.report import Picture
from fcos_lidar_jax.visualization.rerun_recording import rerun_recording


@dataclasses.dataclass(frozen=True)
class Task:
    """A detector or its results, and the truth to compare them with."""

    name: str  # of the truth, for the report
    comparison: Comparison
    sensor: Sensor
    detector: CloudDetector | None = None
    frames: FrameSet | None = None  # None if the report has no points
    notes: tuple[str, ...] = ()  # lines to print when the detection begins


def run_detector(task: Task, out: Path, *, batch_size: int = 1, yaw_rad: float | None = None) -> None:
    """Detect and write the detections; print the numbers of removed points, except for close ones."""
    assert task.detector is not None
    assert task.frames is not None
    comparison = task.comparison
    removed = write_predictions(
        task.detector,
        task.frames,
        out / comparison.file,
        entries=lambda found: (comparison.entries(found.index, found.detections), ""),
        write=comparison.write,
        batch_size=batch_size,
        yaw_rad=yaw_rad,
        notes=task.notes,
    )
    if line := truncation(removed["truncated"], task.detector.config):
        tell(line)
    if removed["invalid"]:
        tell(f"{removed['invalid']} points dropped: not finite, or beyond physical limits")


def write_scores(task: Task, compared: Compared, out: Path, *, bootstrap: int = 0) -> Evaluation:
    """Evaluate, write the scores and print them, with the intervals of a number of resampled sets."""
    for line in compared.warnings:
        tell(f"warning: {line}")
    clear_report(out)  # it may show other numbers
    (out / KITTI_SUMMARY).unlink(missing_ok=True)
    evaluation = evaluate(compared.predictions, compared.truth, task.comparison.metric)
    progress = Progress("sets", bootstrap)
    intervals = write_evaluation(out, evaluation, compared.meta, repeats=bootstrap, report=progress.show)
    for line in warnings(evaluation, len(compared.predictions), compared.truth):
        tell(line)
    print(describe(evaluation, intervals), flush=True)
    if (kitti := write_kitti(out, compared.detections, task.frames)) is not None:
        print(describe_kitti(kitti), flush=True)
    return evaluation


def write_recording(task: Task, evaluation: Evaluation, path: Path) -> None:
    """Write all frames with their boxes and truth for the rerun viewer."""
    assert task.frames is not None
    rows = {token: row for row, token in enumerate(evaluation.tokens)}
    scenes = make_examples(evaluation, task.frames, np.zeros((len(rows), 3)), rows, min_score=0)
    with rerun_recording(path, evaluation.metric.classes, min_score=SHOWN_SCORE) as record:
        for row, scene in enumerate(scenes):
            when = {"time_us": task.frames.time_us(row), "pose": task.frames.pose(row)}
            record(scene.points, scene.detections, name=scene.name, truth=scene.truth, **when)


def write_reports(
    task: Task,
    compared: Compared,
    evaluation: Evaluation,
    out: Path,
    *,
    title: str,
    pictures: Sequence[Picture] = (),
    links: Sequence[tuple[str, str]] = (),
) -> None:
    """Write the report, with more pictures and links, and the page of frames that it links to."""
    examples = choose_examples(evaluation)
    source = evaluation, task.frames, compared.truth.ego_translation
    frames = [
        page_frame(each.points, each.detections, name=f"{each.kind}: {each.name}", truth=each.truth)
        for each in make_examples(*source, examples.extremes, min_score=0, all_sweeps=True)
    ]
    if frames:
        how = {"classes": evaluation.metric.classes, "ego": task.frames is not None}
        write_page(out / PAGE, frames, task.sensor, title=title, **how)
    write_evaluation_report(
        out,
        title=title,
        num_samples=len(compared.truth.tokens),
        examples=make_examples(*source, examples.rows, min_score=SHOWN_SCORE),
        sensor=task.sensor,
        pictures=pictures,
        links=[*links, *([("Look at the worst and the best frames", PAGE)] if frames else [])],
    )
