"""Average precision by centre distance, the errors of the hits, and for the nuScenes benchmark its NDS.

With :data:`NUSCENES_METRIC` every number is that of the official evaluation with its configuration
``detection_cvpr_2019``; :func:`metric_of` makes the metric of any other classes.
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.classes import DEFAULT_RANGE_M, NUSCENES_CLASSES, RANGES_M
from fcos_lidar_jax.evaluation.boxes import BoxColumns, GroundTruth, Racks
from fcos_lidar_jax.evaluation.matching import TP_ERRORS, Ranking, rank

DISTANCES_M = (0.5, 1.0, 2.0, 4.0)
"""Hits are nearer than this; average precision is the mean over the four."""
ERROR_DISTANCE_M = 2.0
"""The errors are those of the hits at this distance."""
ERROR_ROW = DISTANCES_M.index(ERROR_DISTANCE_M)
"""Its row in what is kept by distance."""
MIN_RECALL = MIN_PRECISION = 0.1
"""What is below counts nothing."""
MAX_BOXES = 500
"""Boxes of a sample that an official results file may hold."""
AP_WEIGHT = 5
"""Of mAP in NDS; each of the five errors has weight 1."""

_RECALL = np.linspace(0, 1, 101)
_FIRST = round(100 * MIN_RECALL) + 1


@dataclasses.dataclass(frozen=True)
class Metric:
    """Which classes count, up to which range, and which errors each of them has.

    Labels index ``classes``. Properties go by name: a class named as one of nuScenes behaves as it does there.
    """

    classes: tuple[str, ...]
    """Names of the classes."""
    class_ranges_m: tuple[float, ...]
    """Boxes of a class count when nearer than this."""
    no_attribute: tuple[str, ...]
    """Classes without attributes."""
    no_velocity: tuple[str, ...] = ("traffic_cone", "barrier")
    """Classes whose velocity is not asked for."""
    no_heading: tuple[str, ...] = ("traffic_cone",)
    """Classes without a heading."""
    half_turn: tuple[str, ...] = ("barrier",)
    """Classes that look the same after half a turn."""
    in_racks: tuple[str, ...] = ("bicycle", "motorcycle")
    """Classes that do not count inside a bicycle rack."""
    benchmark: bool = False
    """The nuScenes benchmark: it has NDS, and a class without truth has AP 0 and errors 1."""

    def __post_init__(self) -> None:
        if len(set(self.classes)) != len(self.classes) or not self.classes:
            raise ValueError(f"classes: got {self.classes}, expected at least one name, each once")
        if len(self.class_ranges_m) != len(self.classes) or not all(r > 0 for r in self.class_ranges_m):
            expected = f"{len(self.classes)} positive lengths, one a class"
            raise ValueError(f"class_ranges_m: got {self.class_ranges_m}, expected {expected}")

    @property
    def heading_period_rad(self) -> np.ndarray:
        """f64[classes]: the turn after which a box of each class looks the same, 0 without a heading."""
        periods = [np.pi if name in self.half_turn else 2 * np.pi for name in self.classes]
        return np.where(np.isin(self.classes, self.no_heading), 0.0, periods)

    def has_error(self, name: str, error: str) -> bool:
        """Whether a class has one of the errors of :data:`matching.TP_ERRORS`."""
        without = {"orient_err": self.no_heading, "vel_err": self.no_velocity, "attr_err": self.no_attribute}
        return name not in without.get(error, ())


NUSCENES_METRIC = Metric(
    NUSCENES_CLASSES,
    tuple(int(RANGES_M[name]) for name in NUSCENES_CLASSES),
    no_attribute=("traffic_cone", "barrier"),
    benchmark=True,
)
"""The benchmark's own, ``detection_cvpr_2019``; ranges count from the ego vehicle and not from its sensor."""


def metric_of(classes: Sequence[str], class_ranges_m: Sequence[float] = ()) -> Metric:
    """The metric of any classes: the benchmark's average precision and errors, without attributes and NDS.

    Args:
        classes: names, in the order of the labels.
        class_ranges_m: one a class; default: by the class's name, see ``classes.RANGES_M``.

    Raises:
        ValueError: no class, a name twice, or not one positive range a class.

    >>> metric_of(["pedestrian", "forklift"]).class_ranges_m
    (40.0, 50.0)
    """
    ranges = class_ranges_m or [RANGES_M.get(name, DEFAULT_RANGE_M) for name in classes]
    return Metric(tuple(classes), tuple(ranges), no_attribute=tuple(classes))


@dataclasses.dataclass(frozen=True)
class Curves:
    """What the numbers of one class are made of, at the recalls 0, 0.01 ... 1."""

    precision: np.ndarray
    """f64[t, 101]: for every matching distance; 0 beyond the highest recall."""
    confidence: np.ndarray
    """f64[t, 101]: the score at which a recall is reached; 0 beyond the highest."""
    errors: np.ndarray
    """f64[5, 101]: mean :data:`matching.TP_ERRORS` of the hits up to a recall."""
    num_truth: int
    """Boxes of the class that count."""
    knows_velocity: bool
    """Whether one of them has a velocity."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The numbers, and what they were made of."""

    metric: Metric
    """By which it was evaluated."""
    tokens: tuple[str, ...]
    """The samples."""
    summary: dict[str, Any]
    """See :func:`summarise`."""
    curves: dict[str, Curves]
    """By class."""
    rankings: tuple[Ranking, ...]
    """By label."""
    predictions: BoxColumns
    """Those that count."""
    truth: BoxColumns
    """The boxes that count."""
    seconds: float
    """How long filtering, matching and scoring took."""


def evaluate(predictions: BoxColumns, truth: GroundTruth, metric: Metric = NUSCENES_METRIC) -> Evaluation:
    """Filter, match and score.

    Args:
        predictions: in the order of the results file, ``sample`` counting the truth's samples.
        truth: of the same samples.
        metric: whose classes the labels of both index.
    """
    began = time.perf_counter()
    counted = filter_boxes(predictions, truth.ego_translation, truth.racks, metric)
    true = filter_boxes(truth.boxes, truth.ego_translation, truth.racks, metric)
    period = metric.heading_period_rad
    rankings = rank(counted, true, heading_period_rad=period, distances_m=DISTANCES_M, error_row=ERROR_ROW)
    curves = {name: class_curves(ranking) for name, ranking in zip(metric.classes, rankings, strict=True)}
    summary, seconds = summarise(curves, metric), time.perf_counter() - began
    return Evaluation(metric, truth.tokens, summary, curves, rankings, counted, true, seconds)


def filter_boxes(boxes: BoxColumns, ego_translation: np.ndarray, racks: Racks, metric: Metric) -> BoxColumns:
    """The boxes that are evaluated, in their order.

    Left out is what lies at or beyond its class's range, what holds not a single LiDAR or radar point, and
    bicycles and motorcycles whose centre is in a bicycle rack, boundary included.

    Args:
        boxes: truth or predictions.
        ego_translation: f64[samples, 3], global frame.
        racks: of all samples.
        metric: whose classes the labels index.
    """
    offset = boxes.translation[:, :2] - ego_translation[boxes.sample, :2]
    near = np.sqrt((offset**2).sum(axis=1)) < np.array(metric.class_ranges_m, float)[boxes.label]
    boxes = boxes.take(near & (boxes.num_points != 0))
    cycles = [label for label, name in enumerate(metric.classes) if name in metric.in_racks]
    return boxes.take(~_in_rack(boxes, racks, cycles))


def _in_rack(boxes: BoxColumns, racks: Racks, labels: list[int]) -> np.ndarray:
    """bool[n]: of one of these classes, with its centre in a rack of its sample."""
    inside = np.zeros(len(boxes), bool)
    cycles = np.flatnonzero(np.isin(boxes.label, labels) & np.isin(boxes.sample, racks.sample))
    order = cycles[np.argsort(boxes.sample[cycles], kind="stable")]
    sample = boxes.sample[order]
    for i in range(len(racks.sample)):
        first, last = np.searchsorted(sample, racks.sample[i]), np.searchsorted(sample, racks.sample[i], "right")
        rows = order[first:last]
        local = (boxes.translation[rows] - racks.translation[i]) @ racks.axes[i]
        half = racks.size[i][[1, 0, 2]] / 2
        inside[rows] |= (np.abs(local) <= half).all(axis=1)
    return inside


def class_curves(ranking: Ranking) -> Curves:
    """The curves of one class.

    A distance without a hit, for want of truth or of predictions, has precision and score 0 and errors 1.
    """
    shape = (len(DISTANCES_M), len(_RECALL))
    precision, confidence, errors = np.zeros(shape), np.zeros(shape), np.ones((len(TP_ERRORS), len(_RECALL)))
    rank_from_one = np.arange(1, len(ranking.score) + 1)
    for row, hit in enumerate(ranking.hit):
        if not hit.any():
            continue
        found = np.cumsum(hit)
        recall = found / len(ranking.truth_sample)
        precision[row] = np.interp(_RECALL, recall, found / rank_from_one, right=0)
        confidence[row] = np.interp(_RECALL, recall, ranking.score, right=0)
        if row == ERROR_ROW:
            hit_score = ranking.score[hit][::-1]
            for k, error in enumerate(ranking.errors):
                errors[k] = np.interp(confidence[row, ::-1], hit_score, running_mean(error)[::-1])[::-1]
    return Curves(precision, confidence, errors, len(ranking.truth_sample), ranking.knows_velocity)


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


def summarise(curves: dict[str, Curves], metric: Metric) -> dict[str, Any]:
    """The scores: AP by class and distance, its means, and the errors of the hits.

    For the benchmark the official summary, without ``meta`` and ``eval_time``. Other metrics have neither NDS nor
    attribute errors, velocity errors only of classes whose truth has a velocity, and take all means over the
    classes that occur in the truth; the others are named in ``absent_classes``. No truth at all has mAP NaN.

    Args:
        curves: of all classes of the metric.
        metric: by which they were made.
    """
    counted = {name: curve for name, curve in curves.items() if metric.benchmark or curve.num_truth}
    label_aps = {
        name: {str(d): average_precision(p) for d, p in zip(DISTANCES_M, curve.precision, strict=True)}
        for name, curve in counted.items()
    }
    label_errors = {name: _class_errors(name, curve, metric) for name, curve in counted.items()}
    mean_aps = {name: float(np.mean(list(aps.values()))) for name, aps in label_aps.items()}
    mean_ap = float(np.mean(list(mean_aps.values()))) if mean_aps else float("nan")
    by_error = {e: [errors[e] for errors in label_errors.values() if e in errors] for e in TP_ERRORS}
    tp_errors = {error: float(np.nanmean(values)) for error, values in by_error.items() if values}
    summary = {
        "label_aps": label_aps,
        "mean_dist_aps": mean_aps,
        "mean_ap": mean_ap,
        "label_tp_errors": label_errors,
        "tp_errors": tp_errors,
    }
    matching = {
        "class_range": dict(zip(metric.classes, metric.class_ranges_m, strict=True)),
        "dist_fcn": "center_distance",
        "dist_ths": list(DISTANCES_M),
        "dist_th_tp": ERROR_DISTANCE_M,
        "min_recall": MIN_RECALL,
        "min_precision": MIN_PRECISION,
    }
    if not metric.benchmark:
        absent = [name for name in metric.classes if name not in counted]
        return {
            **summary,
            "absent_classes": absent,
            "cfg": {"metric": "center_distance", "note": _NOTE, **matching},
        }
    scores = {error: max(0.0, 1.0 - value) for error, value in tp_errors.items()}
    nd_score = float(AP_WEIGHT * mean_ap + np.sum(list(scores.values()))) / (AP_WEIGHT + len(scores))
    config = {**matching, "max_boxes_per_sample": MAX_BOXES, "mean_ap_weight": AP_WEIGHT}
    return {**summary, "tp_scores": scores, "nd_score": nd_score, "cfg": config}


_NOTE = "not the nuScenes benchmark: no attributes, no NDS, means over the classes that occur in the truth"


def _class_errors(name: str, curve: Curves, metric: Metric) -> dict[str, float]:
    """Errors of one class; what it does not have is NaN in the benchmark and left out elsewhere."""
    errors = {}
    for error, values in zip(TP_ERRORS, curve.errors, strict=True):
        unknown = error == "vel_err" and not (metric.benchmark or curve.knows_velocity)
        if metric.has_error(name, error) and not unknown:
            errors[error] = mean_error(values, curve.confidence[ERROR_ROW])
        elif metric.benchmark:
            errors[error] = float("nan")
    return errors
