"""Files and text lines of an evaluation, including the official ``metrics_summary.json``."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.boxes import GroundTruth
from fcos_lidar_jax.evaluation.matching import TP_ERRORS
from fcos_lidar_jax.evaluation.metrics import DISTANCES_M, Evaluation, Metric, evaluate, within_range
from fcos_lidar_jax.evaluation.results import read_results
from fcos_lidar_jax.evaluation.truth import read_truth
from fcos_lidar_jax.files import atomic_write


def evaluate_detections(predictions: dict[str, Any] | str | Path, ground_truth: Any) -> dict[str, Any]:
    """Official metrics of detections. All boxes are in the global frame.

    Args:
        predictions: an official results file, or the result of its ``json.load``: ``{"meta", "results"}``.
        ground_truth: ``{sample_token: {"ego_translation": [x, y, z], "boxes": [{"translation", "size" (w, l, h),
            "rotation" (w, x, y, z), "velocity" [vx, vy] or null, "detection_name" (one of the ten or
            "static_object.bicycle_rack"), "attribute_name" ('' without one), "num_pts" (LiDAR and radar)}]}}``, or
            a JSON file with this content.

    Returns:
        content of the official ``metrics_summary.json``: plain dictionaries, with distances as keys ``"0.5"`` to
        ``"4.0"`` and NaN for undefined errors of a class.

    Raises:
        ValueError: naming the sample, the box and the invalid field.

    >>> box = {"translation": [5, 0, 0], "size": [2, 4, 1.5], "rotation": [1, 0, 0, 0], "velocity": [0, 0],
    ...        "detection_name": "car", "attribute_name": "vehicle.parked"}
    >>> truth = {"a": {"ego_translation": [0, 0, 0], "boxes": [{**box, "num_pts": 9}]}}
    >>> found = {"meta": {}, "results": {"a": [{**box, "sample_token": "a", "detection_score": 0.9}]}}
    >>> round(evaluate_detections(found, truth)["mean_dist_aps"]["car"], 9)
    1.0
    """
    truth = read_truth(ground_truth)
    results = read_results(predictions, truth.tokens)
    return full_summary(evaluate(results.boxes, truth), results.meta)


def full_summary(evaluation: Evaluation, meta: Mapping[str, Any]) -> dict[str, Any]:
    """Content of ``metrics_summary.json``; ``meta`` of the results file is included only for the benchmark."""
    metric = evaluation.metric
    summary = {**evaluation.summary, "eval_time": evaluation.seconds, "cfg": metric.settings}
    return {**summary, "meta": meta} if metric.benchmark else summary


def _curves(evaluation: Evaluation) -> dict[str, Any]:
    """Curves behind the summary, by class: number of objects, precision by distance, errors by error."""
    classes, rankings = {}, dict(zip(evaluation.metric.classes, evaluation.rankings, strict=True))
    for name, defined in evaluation.summary["label_tp_errors"].items():
        curves = evaluation.curves[name]
        classes[name] = {
            "num_truth": len(rankings[name].truth_sample),
            "precision": dict(zip(map(str, DISTANCES_M), curves.precision.tolist(), strict=True)),
            "confidence": dict(zip(map(str, DISTANCES_M), curves.confidence.tolist(), strict=True)),
            "errors": {e: v.tolist() for e, v in zip(TP_ERRORS, curves.errors, strict=True) if e in defined},
        }
    return {"recall": np.linspace(0, 1, 101).tolist(), "classes": classes}


def write_evaluation(
    out: Path,
    evaluation: Evaluation,
    meta: Mapping[str, Any],
    *,
    repeats: int = 0,
    report: Callable[[int], None] = lambda done: None,
) -> dict[str, Any] | None:
    """Write ``metrics_summary.json``, ``curves.json`` and, with ``repeats``, ``bootstrap.json``, else remove that.

    ``repeats`` is the number of resampled sets for the intervals of the scores, which are returned, see
    :func:`fcos_lidar_jax.evaluation.bootstrap.bootstrap`; ``report`` is called with the number of finished sets.
    For ``meta`` see :func:`full_summary`.
    """
    (out / "bootstrap.json").unlink(missing_ok=True)  # it may be of other scores
    atomic_write(out / "metrics_summary.json", json.dumps(full_summary(evaluation, meta), indent=2))
    atomic_write(out / "curves.json", json.dumps(_curves(evaluation), indent=2))
    if not repeats:
        return None
    intervals = bootstrap(evaluation, repeats=repeats, report=report)
    atomic_write(out / "bootstrap.json", json.dumps(intervals, indent=2))
    return intervals


def describe(evaluation: Evaluation, intervals: Mapping[str, Any] | None = None) -> str:
    """Text lines of the scores and, if given, their intervals, and a table of the classes; "-" for undefined."""
    summary, benchmark = evaluation.summary, evaluation.metric.benchmark
    names = {"nd_score": "NDS", "mean_ap": "mAP"} if benchmark else {"mean_ap": "mAP by centre distance"}
    scores = "  ".join(f"{name} {summary[key]:.4f}" for key, name in names.items())
    lines = [f"{scores}  on {len(evaluation.tokens)} {'samples' if benchmark else 'frames'}"]
    lines.append("  ".join(f"{name} {value:.4f}" for name, value in summary["tp_errors"].items()))
    if intervals is not None:
        spans = (f"{n} {intervals[k]['low']:.4f} to {intervals[k]['high']:.4f}" for k, n in names.items())
        lines.append(f"{intervals['level']:.0%} intervals over samples: {'; '.join(spans)}")
    return "\n".join(filter(None, [*lines, *_class_table(summary)]))


def _class_table(summary: Mapping[str, Any]) -> list[str]:
    errors, names = list(summary["tp_errors"]), list(summary["mean_dist_aps"])
    header = "".join(f"  {name:>8}" for name in ("AP", *errors))
    lines, width = [], max(map(len, ["class", *names]))
    for name in names:
        own = summary["label_tp_errors"][name]
        values = summary["mean_dist_aps"][name], *(own.get(error, float("nan")) for error in errors)
        cells = zip(("AP", *errors), ("-" if v != v else f"{v:.4f}" for v in values), strict=True)
        lines.append(f"{name:<{width}}" + "".join(f"  {cell:>{max(8, len(head))}}" for head, cell in cells))
    return [f"{'class':<{width}}{header}", *lines]


def warnings(evaluation: Evaluation, num_found: int, truth: GroundTruth | None = None) -> list[str]:
    """Warnings about missing truth and missing detections, which affect the meaning of the scores.

    ``num_found`` and ``truth`` are the detections and the truth before filtering; with the truth, boxes without
    points and boxes beyond their class range are counted, unless in the benchmark.
    """
    benchmark, lines = evaluation.metric.benchmark, []
    rankings = zip(evaluation.metric.classes, evaluation.rankings, strict=True)
    absent = [name for name, ranking in rankings if not len(ranking.truth_sample)]
    if not len(evaluation.truth):
        effect = "every AP is 0 and every error 1" if benchmark else "no score"
        lines.append(f"no ground truth is evaluated: {effect}")
    elif absent:
        rule = "AP 0 and errors 1, as in the benchmark" if benchmark else "excluded from the means"
        lines.append(f"no ground truth is evaluated for {', '.join(absent)}: {rule}")
    if truth is not None and not benchmark:
        lines += _not_evaluated(truth, evaluation.metric)
    if not num_found:
        lines.append("the results contain no boxes: every AP is 0 and every error 1")
    elif not len(evaluation.predictions):
        lines.append("no box of the results is within the range of its class: every AP is 0")
    return lines


def _not_evaluated(truth: GroundTruth, metric: Metric) -> Iterator[str]:
    empty, number = truth.boxes.num_points == 0, len(truth.boxes)
    if empty.any():
        cause = ": are points and boxes in the same frame?" if empty.mean() > 0.5 else ""
        yield f"{empty.sum()} of {number} boxes of the truth contain no point and are not evaluated{cause}"
    far = ~within_range(truth.boxes, truth, metric) & ~empty
    if far.any():
        names = [metric.classes[label] for label in np.unique(truth.boxes.label[far])]
        ranges = ", ".join(f"{name} {metric.ranges_m[name]:g} m" for name in names)
        yield f"{far.sum()} boxes of the truth are beyond the range of their class and are not evaluated: {ranges}"
