"""Report of an evaluation from its files: curves, example pictures and one HTML page."""

import dataclasses
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.evaluation.examples import sensor_boxes
from fcos_lidar_jax.evaluation.kitti import TABLE_HEAD, table_rows
from fcos_lidar_jax.evaluation.kitti_results import KITTI_SUMMARY
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC, Evaluation
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, ScoredBoxes, TrueBoxes
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.camera import draw_camera
from fcos_lidar_jax.visualization.figure import LINE_COLORS, new_axis, save_png
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import Cell, Picture, Table, write_report

ERROR_NAMES = {
    "trans_err": ("ATE", "translation [m]"),
    "scale_err": ("ASE", "scale [1 - IoU]"),
    "orient_err": ("AOE", "orientation [rad]"),
    "vel_err": ("AVE", "velocity [m/s]"),
    "attr_err": ("AAE", "attribute [1 - accuracy]"),
}
"""Errors of the hits: abbreviation, name and unit."""
PAGE = "frames.html"  # interactive page of the worst and the best frames
_MARGIN_M = 2.0  # margin of the bird's-eye views beyond the largest class range


@dataclasses.dataclass(frozen=True)
class Example:
    """An example sample of an evaluation, in its sensor's frame."""

    kind: str  # best, typical or worst
    name: str  # name of the sample
    points: np.ndarray  # f32[n, >= 5]: the cloud; if it is empty, there is no range image
    detections: ScoredBoxes
    truth: TrueBoxes
    camera: tuple[Path, np.ndarray] | None = None  # image, and f64[3, 4] from the sensor's frame to it


def make_examples(
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
        pose, points, camera = np.eye(4), np.zeros((0, 5), np.float32), None
        pose[:3, 3] = centres[row]
        if frames is not None:
            points = frames.frame(row).points
            points = points if all_sweeps else points[points[:, 4] == 0]
            own_pose = frames.pose(row) if evaluation.metric is NUSCENES_METRIC else None
            pose = np.eye(4) if own_pose is None else own_pose
            camera = frames.camera(row)
        found, truth = sensor_boxes(evaluation, row, pose, min_score=min_score)
        yield Example(kind, evaluation.tokens[row], points, found, truth, camera)


def write_evaluation_report(
    out: Path,
    *,
    title: str,
    num_samples: int,
    examples: Iterable[Example],
    sensor: Sensor,
    pictures: Sequence[Picture] = (),
    links: Sequence[tuple[str, str]] = (),
) -> None:
    """Write the self-contained ``report.html``, and its pictures to ``pictures/``.

    Reads scores, errors and curves from ``metrics_summary.json``, ``curves.json`` and, if it exists,
    ``bootstrap.json`` in the folder, of the nuScenes benchmark or any other metric.

    Args:
        examples: samples to plot; ``sensor`` defines their range images.
        pictures: additional pictures, placed first.
        links: text and file name of links to files beside the report.
    """
    summary, curves = (json.loads((out / f"{name}.json").read_text()) for name in ("metrics_summary", "curves"))
    file, folder = out / "bootstrap.json", out / "pictures"
    intervals = json.loads(file.read_text()) if file.is_file() else None
    precisions, errors = _draw_class_curves(folder, summary, curves)
    views, images = _draw_examples(folder, examples, summary["cfg"]["class_range"], sensor)
    defined = [error for error in ERROR_NAMES if error in summary["tp_errors"]]
    distances = [str(distance) for distance in summary["cfg"]["dist_ths"]]
    rows = [
        (
            _words(name),
            curves["classes"][name]["num_truth"],
            summary["mean_dist_aps"][name],
            *(aps[distance] for distance in distances),
            *(summary["label_tp_errors"][name].get(error, float("nan")) for error in defined),
        )
        for name, aps in summary["label_aps"].items()
    ]
    short = [ERROR_NAMES[error][0] for error in defined]
    write_report(
        out / "report.html",
        title=title,
        lead=_lead(summary, num_samples, defined),
        links=links,
        summary=_scores(summary, intervals, defined),
        tables=[
            ("By class", ("class", "objects", "AP", *(f"AP {float(d):g} m" for d in distances), *short), rows),
            *_kitti_table(out / KITTI_SUMMARY),
        ],
        galleries=[("Precision over recall", precisions), ("Mean errors of the hits, up to each recall", errors)],
        pictures=[*pictures, *views],
        wide_pictures=images,
    )


def _kitti_table(file: Path) -> list[Table]:
    if not file.is_file():
        return []
    metrics = json.loads(file.read_text())
    rows = [
        (f"{name}, {kind}", *(float("nan") if value is None else value for value in values), counts)
        for name, kind, values, counts in table_rows(metrics)
    ]
    head = f"KITTI's metric: AP_R40 in percent, on {metrics['num_frames']} frames"
    return [(head, ("class", *TABLE_HEAD), rows)]


def clear_report(out: Path) -> None:
    """Remove the report, its page and the pictures of an earlier evaluation."""
    for name in ("report.html", PAGE):
        (out / name).unlink(missing_ok=True)
    for file in (out / "pictures").glob("*.png"):
        if re.fullmatch(r"(precision|errors)_\d+_.*|(best|typical|worst)_(bev|range|camera)\.png", file.name):
            file.unlink()


def _lead(summary: Mapping[str, Any], num_samples: int, defined: Sequence[str]) -> str:
    rules = f"over {num_samples} samples: average precision (AP) by matching distance"
    if defined:
        names = ", ".join(ERROR_NAMES[error][1].split(" [")[0] for error in defined)
        short = ", ".join(ERROR_NAMES[error][0] for error in defined)
        rules += f", and the mean errors of the hits at {summary['cfg']['dist_th_tp']:g} m in {names} ({short})"
    if "nd_score" in summary:
        return f"The nuScenes detection metrics (detection_cvpr_2019) {rules}."
    absent = ", ".join(map(_words, summary["absent_classes"]))
    missing = f" Without truth here: {absent}." if absent else ""
    return f"Centre-distance metrics {rules}. This is {summary['cfg']['note']}.{missing}"


def _scores(
    summary: Mapping[str, Any], intervals: Mapping[str, Any] | None, defined: Sequence[str]
) -> dict[str, Cell]:
    official = "nd_score" in summary
    names = {"NDS": "nd_score", "mAP": "mean_ap"} if official else {"mAP by centre distance": "mean_ap"}
    scores: dict[str, Cell] = {name: summary[key] for name, key in names.items()}
    if intervals is not None:
        for name, key in names.items():
            low, high = intervals[key]["low"], intervals[key]["high"]
            scores[f"{name}, {intervals['level']:.0%} interval"] = f"{low:.3f} to {high:.3f}"
    return scores | {f"m{ERROR_NAMES[e][0]}, {ERROR_NAMES[e][1]}": summary["tp_errors"][e] for e in defined}


def _draw_class_curves(
    folder: Path, summary: Mapping[str, Any], curves: Mapping[str, Any]
) -> tuple[list[Picture], list[Picture]]:
    """Plot precision and error curves of each class; returns pictures with captions."""
    recall, distance = curves["recall"], str(summary["cfg"]["dist_th_tp"])
    first = round(100 * summary["cfg"]["min_recall"]) + 1
    precisions, errors = list[Picture](), list[Picture]()
    for row, (name, curve) in enumerate(curves["classes"].items()):
        plain = re.sub(r"[^\w-]", "_", name)  # class names may contain characters that file names must not
        above, below = (folder / f"{kind}_{row:02d}_{plain}.png" for kind in ("precision", "errors"))
        _draw_precision(above, recall, curve["precision"])
        precisions.append((f"{_words(name)}: AP {summary['mean_dist_aps'][name]:.3f}", above))
        own = {e: v for e, v in curve["errors"].items() if not np.isnan(summary["label_tp_errors"][name][e])}
        last = int(np.max(np.flatnonzero(curve["confidence"][distance]), initial=0))
        _draw_errors(below, recall, own, last=last, first=first)
        errors.append((_words(name), below))
    return precisions, errors


def _draw_precision(path: str | Path, recall: Sequence[float], precision: Mapping[str, Sequence[float]]) -> None:
    """Plot precision over recall of one class; ``precision`` contains values by matching distance."""
    figure, axis = new_axis(4.2, 3.5)
    for rank, (distance, values) in enumerate(precision.items()):
        # Curves end at the highest recall. Wide lines below narrow ones keep coinciding curves visible.
        end = int(np.max(np.flatnonzero(values), initial=0)) + 1
        style = {"color": LINE_COLORS[rank], "linewidth": 1.2 + rank, "zorder": 9 - rank}
        axis.plot(recall[:end], values[:end], label=f"{float(distance):g} m", **style)
    axis.set_ylim(0, 1.02)
    _save(figure, path, "precision", ncols=4, title="match within")


def _draw_errors(
    path: str | Path, recall: Sequence[float], errors: Mapping[str, Sequence[float]], *, last: int, first: int
) -> None:
    """Plot mean errors of the hits up to each recall, from the minimum to the highest recall."""
    figure, axis = new_axis(4.2, 3.5)
    span, marker = slice(first, last + 1), "o" if last == first else None
    if last >= first:
        for color, (error, (_, name)) in zip(LINE_COLORS, ERROR_NAMES.items(), strict=False):
            if error in errors:
                axis.plot(recall[span], errors[error][span], color=color, linewidth=1.5, label=name, marker=marker)
    else:
        axis.text(0.5, 0.5, "recall never above 0.1", ha="center", transform=axis.transAxes, color="#555555")
    axis.set_ylim(bottom=0)
    _save(figure, path, "mean error of the hits", ncols=2)


def _save(figure: Any, path: str | Path, y_label: str, **legend: Any) -> None:
    axis = figure.axes[0]
    axis.set(xlim=(0, 1), xlabel="recall", ylabel=y_label)
    if handles := axis.get_lines():
        style = {"loc": "outside lower center", "title_fontsize": 9, "fontsize": 9, "frameon": False}
        figure.legend(handles=handles, **style, **legend)
    save_png(figure, path)


def _draw_examples(
    folder: Path, examples: Iterable[Example], ranges_m: Mapping[str, float], sensor: Sensor
) -> tuple[list[Picture], list[Picture]]:
    """Plot bird's-eye views of samples, and, where they have them, range images and boxes in camera images."""
    views, images = list[Picture](), list[Picture]()
    for example in examples:
        points, kind = example.points, example.kind
        view, image, photo = (folder / f"{kind}_{name}.png" for name in ("bev", "range", "camera"))
        boxes = {"classes": list(ranges_m), "truth": example.truth, "detections": example.detections}
        title, limit_m = f"{kind} sample: {example.name}", max(ranges_m.values()) + _MARGIN_M
        draw_bev(points, view, title=title, limit_m=limit_m, **boxes)
        shown = f"detections of score {SHOWN_SCORE:g} and more, truth dashed"
        caption = f"The {kind} sample by hits and misses at 2 m ({example.name}): {shown}."
        views.append((caption, view))
        if example.camera is not None:
            draw_camera(example.camera[0], photo, example.camera[1], **boxes)
            images.append((f"The {kind} sample's camera image ({example.name}).", photo))
        if len(points):
            projected = project_points(points, np.ones(len(points), bool), sensor, num_rounds=1)
            draw_range_image(projected, image, title=title, azimuth_limits_rad=sensor.azimuth_limits_rad, **boxes)
            images.append((f"The {kind} sample's range image: truth above, detections below.", image))
    return views, images


def _words(name: str) -> str:
    return name.replace("_", " ")
