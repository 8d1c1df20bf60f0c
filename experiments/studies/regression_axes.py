"""Along which axes should the network predict the offset of the centre and the velocity?

    python -m experiments.studies.regression_axes --out experiments/results/regression_axes.json

The paper takes those of the LiDAR frame, LaserNet and RangeDet the direction of each point's azimuth
(``model.regression_axes``). The network of ``compact`` is trained with both from random weights, on the same
frames of fresh streets, for the same number of steps, and tested on unseen ones: mAP by centre distance with the
interval of the paired difference over frames drawn anew, AP at the shortest and at the longest matching distance,
the errors of hits, and the IoU of the positives during the last tenth of the training. The same command resumes
it. Cost: twenty minutes for each of the two on two CPU cores.
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.changes import change
from experiments.runs import detections, trained
from experiments.script import Options, run_measurement
from experiments.statistics import paired_difference
from experiments.studies.shipped_weights import CONFIGS, streets
from fcos_lidar_jax.data.frame import ChosenFrames
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.matching import DISTANCES_M
from fcos_lidar_jax.evaluation.metrics import Evaluation, metric_of
from fcos_lidar_jax.training.metrics_log import read_metrics

AXES: tuple[Literal["lidar", "ray"], ...] = ("lidar", "ray")
_LAST = 0.1  # Part of the training that the IoU of the positives is a mean over.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """How long, and on how much."""

    steps: int = 1500  # Updates of each training, on a frame each.
    seed: int = 0  # Of weights and streets.
    test_frames: int = 200  # Unseen frames.
    work: Path = Path("outputs/regression_axes")  # Folder of the runs.


def figures(evaluation: Evaluation, run: Path, steps: int) -> dict[str, Any]:
    """Scores of a training, and how well its boxes fit."""
    summary, records = evaluation.summary, read_metrics(run)
    late = [r["positive_iou"] for r in records if "positive_iou" in r and r["step"] > (1 - _LAST) * steps]
    near, far = (
        np.mean([aps[str(distance)] for aps in summary["label_aps"].values()])
        for distance in (min(DISTANCES_M), max(DISTANCES_M))
    )
    return {
        "mAP": round(summary["mean_ap"], 4),
        f"AP at {min(DISTANCES_M):g} m": round(float(near), 4),
        f"AP at {max(DISTANCES_M):g} m": round(float(far), 4),
        "centre error of hits, m": round(summary["tp_errors"]["trans_err"], 3),
        "velocity error of hits, m/s": round(summary["tp_errors"]["vel_err"], 3),
        "IoU of the last positives": round(float(np.mean(late)), 4),
    }


def measure(args: Args) -> dict[str, Any]:
    """Train what is missing, evaluate, compare."""
    evaluations: dict[str, Evaluation] = {}
    record: dict[str, Any] = {"steps": args.steps, "test_frames": args.test_frames}
    for axes in AXES:
        config = change(model__regression_axes=axes)(CONFIGS["hdl32e"])
        shown, unseen = streets(config, steps=args.steps, seed=args.seed)
        folder = args.work / f"{axes}_{args.steps}_{args.seed}"
        detector = trained(folder, config, shown, steps=args.steps, seed=args.seed)
        found, frames = detections(detector, ChosenFrames(unseen, tuple(range(args.test_frames))))
        evaluations[axes] = evaluate_frames(found, frames, metric_of(detector.classes))
        record[axes] = figures(evaluations[axes], folder, args.steps)
    lidar, ray = (evaluations[axes] for axes in AXES)
    low, high = paired_difference(lidar, ray)
    difference = ray.summary["mean_ap"] - lidar.summary["mean_ap"]
    return record | {"difference": round(difference, 4), "interval": [round(low, 4), round(high, 4)]}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
