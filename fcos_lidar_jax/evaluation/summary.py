"""From files to the official ``metrics_summary.json``, and the curves behind it."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.metrics import DISTANCES_M, Evaluation, evaluate
from fcos_lidar_jax.evaluation.ranking import TP_ERRORS
from fcos_lidar_jax.evaluation.results import read_results
from fcos_lidar_jax.evaluation.truth import read_truth
from fcos_lidar_jax.files import write_beside


def evaluate_detections(predictions: dict[str, Any] | str | Path, ground_truth: Any) -> dict[str, Any]:
    """The official metrics of detections, all in the global frame.

    Args:
        predictions: an official results file, or what ``json.load`` gives for it: ``{"meta", "results"}``.
        ground_truth: ``{sample_token: {"ego_translation": [x, y, z], "boxes": [{"translation", "size" (w, l, h),
            "rotation" (w, x, y, z), "velocity" [vx, vy] or null, "detection_name" of the ten or
            "static_object.bicycle_rack", "attribute_name" ('' for none), "num_pts" (LiDAR and radar)}]}}``, or a
            JSON file of it.

    Returns:
        what ``json.load`` gives for the official ``metrics_summary.json``: plain dictionaries, distances as keys
        ``"0.5"`` ... ``"4.0"``, NaN for the errors that a class does not have.

    Raises:
        ValueError: naming the sample, the box and the field that is wrong.

    >>> box = {"translation": [5, 0, 0], "size": [2, 4, 1.5], "rotation": [1, 0, 0, 0], "velocity": [0, 0],
    ...        "detection_name": "car", "attribute_name": "vehicle.parked"}
    >>> truth = {"a": {"ego_translation": [0, 0, 0], "boxes": [{**box, "num_pts": 9}]}}
    >>> found = {"meta": {}, "results": {"a": [{**box, "sample_token": "a", "detection_score": 0.9}]}}
    >>> round(evaluate_detections(found, truth)["mean_dist_aps"]["car"], 9)
    1.0
    """
    truth = read_truth(ground_truth)
    results = read_results(predictions, truth.tokens)
    began = time.perf_counter()
    evaluation = evaluate(results.boxes, truth)
    return official_summary(evaluation, meta=results.meta, eval_time=time.perf_counter() - began)


def official_summary(evaluation: Evaluation, *, meta: dict[str, Any], eval_time: float) -> dict[str, Any]:
    """All that ``metrics_summary.json`` holds.

    Args:
        evaluation: the numbers.
        meta: of the results file.
        eval_time: seconds that filtering, matching and scoring took.
    """
    summary = dict(evaluation.summary)
    config = summary.pop("cfg")
    return {**summary, "eval_time": eval_time, "cfg": config, "meta": meta}


def curve_record(evaluation: Evaluation) -> dict[str, Any]:
    """The curves as a JSON object: precision by class, distance and recall; errors by class, error and recall."""
    classes = {}
    for name, curves in evaluation.curves.items():
        by_distance = dict(
            zip(map(str, DISTANCES_M), zip(curves.precision, curves.confidence, strict=True), strict=True)
        )
        classes[name] = {
            "precision": {key: precision.tolist() for key, (precision, _) in by_distance.items()},
            "confidence": {key: confidence.tolist() for key, (_, confidence) in by_distance.items()},
            "errors": {key: values.tolist() for key, values in zip(TP_ERRORS, curves.errors, strict=True)},
        }
    return {"recall": np.linspace(0, 1, 101).tolist(), "classes": classes}


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, whole or not at all."""
    write_beside(path, lambda file: file.write_text(json.dumps(value, indent=2), encoding="utf-8"))
