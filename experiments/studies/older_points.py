"""What older points give and cost: training losses, and detections where moving objects were.

    python -m experiments.studies.older_points --trained RUN... --out experiments/results/older_points.json

Compares runs of the scale ``sector`` that saw the same frames, such as rows of ``mrv_ablations`` with one seed. A
*ghost* is a detection whose centre lies in no object, but in a box of the last half second: the current box of an
object, moved back at constant velocity. The older points of the object lie there. The record names each run by
its folder, and has:

- the losses of the boxes over the last thousand training steps, per positive location, and the positives per step.
  The classification loss is left out: it is a sum over all occupied locations, of which ten sweeps have more
- mAP and AP by class on the test frames: of all detections, without the ghosts, and, to compare, without the
  detections that are as far ahead of an object and no ghosts

Cost: one minute of one CPU core per run.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper_tables.scales import quarter
from experiments.runs import benchmark, detections
from experiments.script import Options, run_measurement
from fcos_lidar_jax.data.box_geometry import points_in_boxes
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.simulation.lidar import SWEEP_S
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.types import Detections

LAGS_S = SWEEP_S * np.arange(1, 11)  # The oldest points of ten sweeps were measured half a second ago.
STEPS = 1000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the comparison."""

    trained: tuple[Path, ...]  # Finished runs of the scale sector.
    frames: Path = Path("outputs/runs/frames")  # Folder of the simulated frames.


def ghosts(boxes: np.ndarray, truth: np.ndarray, lags_s: np.ndarray = LAGS_S) -> np.ndarray:
    """Find the boxes with the centre in no object now, but in one that was moved back by one of the lags.

    Args:
        boxes: f32[n, 9], detections.
        truth: f32[m, 9], current boxes of the objects.
        lags_s: f64[k]; negative lags move the objects forward.

    Returns:
        bool[n].
    """

    def in_object(lag_s: float) -> np.ndarray:
        moved = np.concatenate([truth[:, :2] - lag_s * truth[:, 7:9], truth[:, 2:]], axis=1)
        inside = np.zeros(len(boxes), bool)
        for rows in points_in_boxes(boxes, moved):
            inside[rows] = True
        return inside

    return np.any([in_object(lag) for lag in lags_s], axis=0) & ~in_object(0.0)


def ahead(boxes: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Find the boxes that are as far ahead of an object as ghosts are behind it, without the ghosts of others."""
    return ghosts(boxes, truth, -LAGS_S) & ~ghosts(boxes, truth)


def training_losses(metrics: list[dict[str, Any]]) -> dict[str, float]:
    """Average the losses of the boxes over the positives of the last thousand steps."""
    rows = [row for row in metrics if "loss/total" in row]
    last = [row for row in rows if row["step"] > rows[-1]["step"] - STEPS]
    positives = [row["positives"] for row in last]
    means = {name: np.average([row[f"loss/{name}"] for row in last], weights=positives) for name in ("iou", "l1")}
    return {"positives": round(float(np.mean(positives)), 1)} | {k: round(float(v), 3) for k, v in means.items()}


def scores(
    found: list[Detections], frames: list[Frame], dropped: Callable[[np.ndarray, np.ndarray], np.ndarray] | None
) -> dict[str, Any]:
    """Score the detections, without those that ``dropped`` finds from boxes and truth."""
    if dropped is not None:
        pairs = zip(found, frames, strict=True)
        found = [dataclasses.replace(d, valid=d.valid & ~dropped(np.asarray(d.boxes), f.boxes)) for d, f in pairs]
    summary = benchmark(found, frames).summary
    return {
        "mAP": round(summary["mean_ap"], 4),
        "AP": {name: round(ap, 3) for name, ap in summary["mean_dist_aps"].items()},
    }


def measure(args: Args) -> dict[str, Any]:
    """Measure each run."""
    scale, record = quarter(args.frames), dict[str, Any]()
    for path in args.trained:
        detector = load_trained(path)
        found, frames = detections(detector, scale.frames("test", detector.config.num_sweeps))
        record[path.name] = {
            "training losses": training_losses(read_metrics(path)),
            "all detections": scores(found, frames, None),
            "without ghosts": scores(found, frames, ghosts),
            "without detections ahead": scores(found, frames, ahead),
        }
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
