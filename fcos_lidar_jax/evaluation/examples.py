"""Example samples of an evaluation: the best, a typical and the worst."""

import dataclasses

import numpy as np

from fcos_lidar_jax.data.box_geometry import transform_boxes
from fcos_lidar_jax.evaluation.boxes import BoxColumns
from fcos_lidar_jax.evaluation.metrics import ERROR_ROW, Evaluation
from fcos_lidar_jax.evaluation.records import ScoredBoxes, TrueBoxes

_EXTREMES = 3  # number of worst and of best samples


@dataclasses.dataclass(frozen=True)
class Examples:
    """Samples to plot, and the score threshold of their detections."""

    rows: dict[str, int]  # best, typical and worst -> row of the sample; fewer entries if there are fewer samples
    extremes: dict[str, int]  # worst 1 to 3 and best 1 to 3 -> row of the sample, without duplicates
    min_score: float  # threshold with the highest F1 over all samples


def choose_examples(evaluation: Evaluation) -> Examples:
    """Choose samples by F1 at two metres over all classes, at the threshold with the highest overall F1.

    Among samples with equal F1, the sample with the most truth comes first. Samples without truth are skipped.
    """
    rankings, num_samples = evaluation.rankings, len(evaluation.tokens)
    of_class = [(ranking.score, ranking.hit[ERROR_ROW], ranking.sample) for ranking in rankings]
    score, hit, sample = (np.concatenate(columns) for columns in zip(*of_class, strict=True))
    truth = np.bincount(np.concatenate([r.truth_sample for r in rankings]), minlength=num_samples)
    order = np.argsort(-score, kind="stable")
    found = np.cumsum(hit[order])
    f1 = 2 * found / (np.arange(1, len(order) + 1) + truth.sum())
    f1[:-1][np.diff(score[order]) == 0] = -1  # a threshold takes all equal scores
    min_score = float(score[order[np.argmax(f1)]]) if len(f1) else 0.0
    shown = score >= min_score
    hits = np.bincount(sample[shown & hit], minlength=num_samples)
    quality = 2 * hits / np.maximum(np.bincount(sample[shown], minlength=num_samples) + truth, 1)
    candidates = np.flatnonzero(truth)
    if not len(candidates):
        return Examples({}, {}, min_score)
    most = -truth[candidates]
    falling, rising = (candidates[np.lexsort((most, q[candidates]))].tolist() for q in (-quality, quality))
    # Each sample has one name. The last assignment wins.
    names = {falling[len(falling) // 2]: "typical", rising[0]: "worst", falling[0]: "best"}
    worst = rising[:_EXTREMES]
    ranked = {"worst": worst, "best": [row for row in falling[:_EXTREMES] if row not in worst]}
    extremes = {f"{kind} {place}": row for kind, rows in ranked.items() for place, row in enumerate(rows, 1)}
    return Examples(dict(sorted((name, row) for row, name in names.items())), extremes, min_score)


def sensor_boxes(
    evaluation: Evaluation, sample: int, sensor_to_global: np.ndarray, *, min_score: float
) -> tuple[ScoredBoxes, TrueBoxes]:
    """Evaluated predictions (boxes, labels, scores) and truth (boxes, labels) of a sample in a sensor's frame.

    ``sensor_to_global`` is the pose of the sensor, f64[4, 4]; ``min_score`` is the threshold of the predictions.
    """
    from_global = np.linalg.inv(sensor_to_global)

    def local(boxes: BoxColumns) -> np.ndarray:
        columns = boxes.translation, boxes.size[:, [1, 0, 2]], boxes.yaw, boxes.velocity
        return transform_boxes(np.column_stack(columns), from_global)

    found, truth = evaluation.predictions, evaluation.truth
    found = found.take((found.sample == sample) & (found.score >= min_score))
    truth = truth.take(truth.sample == sample)
    return (local(found), found.label, found.score), (local(truth), truth.label)
