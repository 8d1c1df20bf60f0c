"""The nuScenes detection metric: average precision by centre distance, errors of the hits, and NDS.

Every number is that of the official evaluation with its configuration ``detection_cvpr_2019``.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.boxes import BoxColumns, GroundTruth
from fcos_lidar_jax.evaluation.filtering import CLASS_RANGE_M, filter_boxes
from fcos_lidar_jax.evaluation.ranking import TP_ERRORS, Ranking, rank
from fcos_lidar_jax.types import CLASSES

DISTANCES_M = (0.5, 1.0, 2.0, 4.0)
"""Hits are nearer than this; average precision is the mean over the four."""
ERROR_DISTANCE_M = 2.0
"""The errors are those of the hits at this distance."""
MIN_RECALL = MIN_PRECISION = 0.1
"""What is below counts nothing."""
MAX_BOXES = 500
"""Boxes of a sample that a result may hold."""
AP_WEIGHT = 5
"""Of mAP in NDS; each of the five errors has weight 1."""

_RECALL = np.linspace(0, 1, 101)
_FIRST = round(100 * MIN_RECALL) + 1
_UNDEFINED = {"traffic_cone": ("orient_err", "vel_err", "attr_err"), "barrier": ("vel_err", "attr_err")}
"""Errors that a class does not have."""


@dataclasses.dataclass(frozen=True)
class Curves:
    """What the numbers of one class are made of, at the recalls 0, 0.01 ... 1."""

    precision: np.ndarray
    """f64[t, 101]: for every matching distance; 0 beyond the highest recall."""
    confidence: np.ndarray
    """f64[t, 101]: the score at which a recall is reached; 0 beyond the highest."""
    errors: np.ndarray
    """f64[5, 101]: mean :data:`ranking.TP_ERRORS` of the hits up to a recall."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The numbers, and what they were made of."""

    summary: dict[str, Any]
    """As in the official ``metrics_summary.json``, without ``meta`` and ``eval_time``."""
    curves: dict[str, Curves]
    """By class."""
    rankings: tuple[Ranking, ...]
    """By label."""
    predictions: BoxColumns
    """Those that count."""
    truth: BoxColumns
    """The boxes that count."""


def evaluate(predictions: BoxColumns, truth: GroundTruth) -> Evaluation:
    """Filter, match and score.

    Args:
        predictions: in the order of the results file, ``sample`` counting the truth's samples.
        truth: of the same samples.
    """
    counted = filter_boxes(predictions, truth.ego_translation, truth.racks)
    true = filter_boxes(truth.boxes, truth.ego_translation, truth.racks)
    rankings = rank(counted, true, distances_m=DISTANCES_M, error_row=DISTANCES_M.index(ERROR_DISTANCE_M))
    curves = {name: draw(ranking) for name, ranking in zip(CLASSES, rankings, strict=True)}
    return Evaluation(summarise(curves), curves, rankings, counted, true)


def draw(ranking: Ranking, distances_m: Sequence[float] = DISTANCES_M) -> Curves:
    """The curves of one class.

    A distance without a hit, for want of truth or of predictions, has precision and score 0 and errors 1.

    Args:
        ranking: of the class.
        distances_m: of its hits.
    """
    shape = (len(distances_m), len(_RECALL))
    precision, confidence, errors = np.zeros(shape), np.zeros(shape), np.ones((len(TP_ERRORS), len(_RECALL)))
    rank_from_one = np.arange(1, len(ranking.score) + 1)
    for row, distance_m in enumerate(distances_m):
        hit = ranking.hit[row]
        if not hit.any():
            continue
        found = np.cumsum(hit)
        recall = found / len(ranking.truth_sample)
        precision[row] = np.interp(_RECALL, recall, found / rank_from_one, right=0)
        confidence[row] = np.interp(_RECALL, recall, ranking.score, right=0)
        if distance_m == ERROR_DISTANCE_M:
            hit_score = ranking.score[hit][::-1]
            for k, error in enumerate(ranking.errors):
                errors[k] = np.interp(confidence[row, ::-1], hit_score, running_mean(error)[::-1])[::-1]
    return Curves(precision, confidence, errors)


def running_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the values so far that are not NaN; 0 before the first, and 1 throughout if there is none.

    >>> running_mean(np.array([np.nan, 2.0, 4.0])).tolist()
    [0.0, 2.0, 3.0]
    """
    known = ~np.isnan(values)
    if not known.any():
        return np.ones(len(values))
    count = np.cumsum(known)
    return np.divide(np.nancumsum(values), count, out=np.zeros(len(values)), where=count != 0)


def average_precision(precision: np.ndarray) -> float:
    """Area under a curve f64[101] above the floors of recall and precision, 1 at best.

    >>> round(average_precision(np.ones(101)), 9)
    1.0
    """
    above = np.maximum(precision[_FIRST:] - MIN_PRECISION, 0)
    return float(np.mean(above)) / (1 - MIN_PRECISION)


def mean_error(error: np.ndarray, confidence: np.ndarray) -> float:
    """Mean of an error curve f64[101] from the recall floor to the highest recall; 1 if that is not reached.

    Args:
        error: curve.
        confidence: of the same hits; 0 beyond the highest recall.
    """
    reached = np.flatnonzero(confidence)
    last = int(reached[-1]) if len(reached) else 0
    return 1.0 if last < _FIRST else float(np.mean(error[_FIRST : last + 1]))


def summarise(curves: dict[str, Curves], distances_m: Sequence[float] = DISTANCES_M) -> dict[str, Any]:
    """The official summary, without ``meta`` and ``eval_time``.

    Args:
        curves: of all ten classes.
        distances_m: of their rows.
    """
    at = distances_m.index(ERROR_DISTANCE_M)
    label_aps = {
        name: {str(d): average_precision(p) for d, p in zip(distances_m, curve.precision, strict=True)}
        for name, curve in curves.items()
    }
    label_errors = {
        name: {
            error: float("nan")
            if error in _UNDEFINED.get(name, ())
            else mean_error(curve.errors[k], curve.confidence[at])
            for k, error in enumerate(TP_ERRORS)
        }
        for name, curve in curves.items()
    }
    mean_aps = {name: float(np.mean(list(aps.values()))) for name, aps in label_aps.items()}
    mean_ap = float(np.mean(list(mean_aps.values())))
    errors = {e: float(np.nanmean([of_class[e] for of_class in label_errors.values()])) for e in TP_ERRORS}
    scores = {error: max(0.0, 1.0 - value) for error, value in errors.items()}
    return {
        "label_aps": label_aps,
        "mean_dist_aps": mean_aps,
        "mean_ap": mean_ap,
        "label_tp_errors": label_errors,
        "tp_errors": errors,
        "tp_scores": scores,
        "nd_score": float(AP_WEIGHT * mean_ap + np.sum(list(scores.values()))) / (AP_WEIGHT + len(scores)),
        "cfg": {
            "class_range": dict(CLASS_RANGE_M),
            "dist_fcn": "center_distance",
            "dist_ths": list(distances_m),
            "dist_th_tp": ERROR_DISTANCE_M,
            "min_recall": MIN_RECALL,
            "min_precision": MIN_PRECISION,
            "max_boxes_per_sample": MAX_BOXES,
            "mean_ap_weight": AP_WEIGHT,
        },
    }
