"""Average precision by centre distance, errors of the hits, and the NDS of the nuScenes benchmark.

:data:`NUSCENES_METRIC` reproduces all numbers of the official evaluation with the configuration
``detection_cvpr_2019``; :func:`metric_of` creates a metric for any other classes.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.classes import DEFAULT_RANGE_M, NUSCENES_CLASSES, RANGES_M
from fcos_lidar_jax.evaluation.boxes import BoxColumns, GroundTruth
from fcos_lidar_jax.evaluation.matching import DISTANCES_M, ERROR_ROW, TP_ERRORS, Ranking, candidate_pairs, rank
from fcos_lidar_jax.fields import check

MIN_RECALL = MIN_PRECISION = 0.1  # lower values do not contribute to the AP
MAX_BOXES = 500  # maximum number of boxes per sample in an official results file
AP_WEIGHT = 5  # weight of mAP in NDS; each of the five errors has weight 1

_RECALL = np.linspace(0, 1, 101)
_FIRST = round(100 * MIN_RECALL) + 1
_WITHOUT = {"traffic_cone": {"orient_err", "vel_err", "attr_err"}, "barrier": {"vel_err", "attr_err"}}
"""Class -> errors that are undefined for it."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """Evaluated classes and their ranges.

    Labels index ``classes``. A class with the name of a nuScenes class has the properties of that class.
    """

    ranges_m: Mapping[str, float]  # range of each class; farther boxes are not evaluated
    benchmark: bool = False  # nuScenes benchmark, with NDS and attributes; without truth, AP is 0 and errors are 1

    def __post_init__(self) -> None:
        positive = len(self.ranges_m) > 0 and all(range_m > 0 for range_m in self.ranges_m.values())
        check(positive, "ranges_m", self.ranges_m, "a positive length for each of at least one class")

    @property
    def classes(self) -> tuple[str, ...]:
        return tuple(self.ranges_m)

    @property
    def heading_period_rad(self) -> np.ndarray:
        """Period per class, f64[classes], see :func:`~.matching.heading_error`."""
        periods = {"traffic_cone": 0.0, "barrier": np.pi}
        return np.array([periods.get(name, 2 * np.pi) for name in self.classes])

    @property
    def settings(self) -> dict[str, Any]:
        """Settings as in the field ``cfg`` of ``metrics_summary.json``."""
        matching = {
            "class_range": dict(self.ranges_m),
            "dist_fcn": "center_distance",
            "dist_ths": list(DISTANCES_M),
            "dist_th_tp": DISTANCES_M[ERROR_ROW],
            "min_recall": MIN_RECALL,
            "min_precision": MIN_PRECISION,
        }
        if self.benchmark:
            return {**matching, "max_boxes_per_sample": MAX_BOXES, "mean_ap_weight": AP_WEIGHT}
        note = "not the nuScenes benchmark: no attributes, no NDS, means over the classes that occur in the truth"
        return {"metric": "center_distance", "note": note, **matching}


NUSCENES_METRIC = Metric({name: int(RANGES_M[name]) for name in NUSCENES_CLASSES}, benchmark=True)
"""The benchmark's metric, ``detection_cvpr_2019``; ranges are measured from the ego vehicle, not the sensor."""


def metric_of(classes: Sequence[str], class_ranges_m: Sequence[float] = ()) -> Metric:
    """Create a metric for any classes: the benchmark's average precision and errors without attributes and NDS.

    The classes are in the order of the labels. By default, their ranges follow from their names, see
    ``classes.RANGES_M``.

    >>> metric_of(["pedestrian", "forklift"]).ranges_m
    {'pedestrian': 40.0, 'forklift': 50.0}
    """
    check(len({*classes}) == len(classes), "classes", classes, "different names")
    ranges = class_ranges_m or [RANGES_M.get(name, DEFAULT_RANGE_M) for name in classes]
    return Metric(dict(zip(classes, ranges, strict=True)))


@dataclasses.dataclass(frozen=True)
class Curves:
    """Curves of one class at the recalls 0, 0.01, ..., 1."""

    precision: np.ndarray  # f64[t, 101]: precision per matching distance; 0 beyond the highest recall
    confidence: np.ndarray  # f64[t, 101]: score at which a recall is reached; 0 beyond the highest recall
    errors: np.ndarray  # f64[5, 101]: mean TP_ERRORS of the hits up to a recall


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation."""

    metric: Metric
    tokens: tuple[str, ...]  # names of the samples
    summary: dict[str, Any]  # see score
    curves: dict[str, Curves]  # by class
    rankings: tuple[Ranking, ...]  # by label
    predictions: BoxColumns  # after filtering
    truth: BoxColumns  # after filtering
    seconds: float  # time of filtering, matching and scoring


def evaluate(predictions: BoxColumns, truth: GroundTruth, metric: Metric = NUSCENES_METRIC) -> Evaluation:
    """Filter, match and score predictions, in the order of the results file; ``sample`` indexes ``truth.tokens``.

    Labels of predictions and truth index the classes of the metric.
    """
    began = time.perf_counter()
    predictions, true = (filter_boxes(boxes, truth, metric) for boxes in (predictions, truth.boxes))
    rankings = rank(predictions, true, heading_period_rad=metric.heading_period_rad)
    curves, summary = score(rankings, metric)
    seconds = time.perf_counter() - began
    return Evaluation(metric, truth.tokens, summary, curves, rankings, predictions, true, seconds)


def filter_boxes(boxes: BoxColumns, truth: GroundTruth, metric: Metric) -> BoxColumns:
    """Select the evaluated boxes, truth or predictions, in order.

    Drops boxes at or beyond the range of their class, boxes without LiDAR or radar points, and bicycles and
    motorcycles whose centre lies in a bicycle rack, boundary included.
    """
    near = within_range(boxes, truth, metric)
    boxes, racks = boxes.take(near & (boxes.num_points != 0)), truth.racks
    cycles = np.flatnonzero(np.isin(metric.classes, ("bicycle", "motorcycle"))[boxes.label])
    own = boxes.take(cycles)
    centres, rack_centres = own.translation[:, :2], racks.translation[:, :2]
    pairs = candidate_pairs(own.sample, centres, racks.sample, rack_centres, max_distance_m=np.inf)
    offset = own.translation[pairs.detection] - racks.translation[pairs.truth]
    local = np.matmul(offset[:, None], truth.rack_axes[pairs.truth])[:, 0]
    inside = (np.abs(local) <= racks.size[pairs.truth][:, [1, 0, 2]] / 2).all(axis=1)
    return boxes.take(~np.isin(np.arange(len(boxes)), cycles[pairs.detection[inside]]))


def within_range(boxes: BoxColumns, truth: GroundTruth, metric: Metric) -> np.ndarray:
    """Whether boxes are nearer to ``truth.ego_translation`` than the range of their class, bool[n]."""
    offset = boxes.translation[:, :2] - truth.ego_translation[boxes.sample, :2]
    return np.sqrt((offset**2).sum(axis=1)) < np.array([*metric.ranges_m.values()])[boxes.label]


def class_curves(ranking: Ranking) -> Curves:
    """Curves of one class. For a distance without hits, precision and score are 0 and errors are 1."""
    shape = (len(DISTANCES_M), len(_RECALL))
    precision, confidence, errors = np.zeros(shape), np.zeros(shape), np.ones((len(TP_ERRORS), len(_RECALL)))
    rank_from_one = np.arange(1, len(ranking.score) + 1)
    for row, hit in enumerate(ranking.hit):
        if not hit.any():
            continue
        num_hits = np.cumsum(hit)
        recall = num_hits / len(ranking.truth_sample)
        precision[row] = np.interp(_RECALL, recall, num_hits / rank_from_one, right=0)
        confidence[row] = np.interp(_RECALL, recall, ranking.score, right=0)
        if row == ERROR_ROW:
            hit_score = ranking.score[hit][::-1]
            for k, error in enumerate(ranking.errors):
                errors[k] = np.interp(confidence[row, ::-1], hit_score, running_mean(error)[::-1])[::-1]
    return Curves(precision, confidence, errors)


def running_mean(values: np.ndarray) -> np.ndarray:
    """Running mean of the values that are not NaN: 0 before the first such value, 1 throughout if there is none.

    >>> running_mean(np.array([np.nan, 2.0, 4.0])).tolist()
    [0.0, 2.0, 3.0]
    """
    known = ~np.isnan(values)
    if not known.any():
        return np.ones(len(values))
    count = np.cumsum(known)
    return np.divide(np.nancumsum(values), count, out=np.zeros(len(values)), where=count != 0)


def average_precision(precision: np.ndarray) -> float:
    """Area under a precision curve f64[101] above the minimum recall and precision, scaled to at most 1.

    >>> round(average_precision(np.ones(101)), 9)
    1.0
    """
    above = np.maximum(precision[_FIRST:] - MIN_PRECISION, 0)
    return float(np.mean(above)) / (1 - MIN_PRECISION)


def mean_error(error: np.ndarray, confidence: np.ndarray) -> float:
    """Mean of an error curve f64[101] from the minimum to the highest recall; 1 if the minimum is not reached.

    ``confidence`` is 0 beyond the highest recall.
    """
    last = int(np.max(np.flatnonzero(confidence), initial=0))
    return 1.0 if last < _FIRST else float(np.mean(error[_FIRST : last + 1]))


def score(rankings: Sequence[Ranking], metric: Metric) -> tuple[dict[str, Curves], dict[str, Any]]:
    """Curves per class, and the scores: AP per class and distance, its means, and the errors of the hits.

    For the benchmark, the scores are the official summary without ``eval_time``, ``cfg`` and ``meta``. Other
    metrics have neither NDS nor attribute errors, and have velocity errors only for classes whose truth has
    velocities. Their means are over the classes that occur in the truth; ``absent_classes`` lists the other
    classes. Without any truth the mAP is NaN.
    """
    benchmark, all_errors = metric.benchmark, {}
    of_class = dict(zip(metric.classes, rankings, strict=True))
    curves = {name: class_curves(ranking) for name, ranking in of_class.items()}
    counted = [name for name, ranking in of_class.items() if benchmark or len(ranking.truth_sample)]
    label_aps = {
        name: {str(d): average_precision(p) for d, p in zip(DISTANCES_M, curves[name].precision, strict=True)}
        for name in counted
    }
    for name in counted:
        unknown, confidence = _WITHOUT.get(name, set()), curves[name].confidence[ERROR_ROW]
        if not benchmark:
            unknown = unknown | ({"attr_err"} if of_class[name].knows_velocity else {"attr_err", "vel_err"})
        all_errors[name] = {
            error: float("nan") if error in unknown else mean_error(values, confidence)
            for error, values in zip(TP_ERRORS, curves[name].errors, strict=True)
            if benchmark or error not in unknown
        }
    mean_aps = {name: float(np.mean(list(aps.values()))) for name, aps in label_aps.items()}
    mean_ap = float(np.mean(list(mean_aps.values()))) if mean_aps else float("nan")
    by_error = {e: [errors[e] for errors in all_errors.values() if e in errors] for e in TP_ERRORS}
    tp_errors = {error: float(np.nanmean(values)) for error, values in by_error.items() if values}
    summary: dict[str, Any] = {"label_aps": label_aps, "mean_dist_aps": mean_aps, "mean_ap": mean_ap}
    summary |= {"label_tp_errors": all_errors, "tp_errors": tp_errors}
    if not benchmark:
        return curves, {**summary, "absent_classes": [name for name in metric.classes if name not in counted]}
    scores = {error: max(0.0, 1.0 - value) for error, value in tp_errors.items()}
    nd_score = float(AP_WEIGHT * mean_ap + np.sum(list(scores.values()))) / (AP_WEIGHT + len(scores))
    return curves, {**summary, "tp_scores": scores, "nd_score": nd_score}
