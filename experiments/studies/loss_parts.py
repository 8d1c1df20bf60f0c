"""What is each part of the loss for? Trained without it, the figure it exists for gets worse.

    python -m experiments.studies.loss_parts

Overfits a few simulated frames with the quickstart, once with all parts and once without each, and detects on the
same frames. Per part one figure, from three seeds each:

- classification: mAP;
- L1: the orientation error of the matched detections, and, for its last two numbers, the velocity error;
- IoU: the mean IoU of the positives, over the last steps;
- IoU prediction: the cross-entropy between the predicted and the true IoU of the positives, over the last steps.

Cost: about half an hour on one CPU core. Expected: every "off" is worse than "all parts" in its own figure.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np

from experiments.runs import detections, trained
from experiments.script import run_script, save
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames, fresh_streets
from fcos_lidar_jax.training.metrics_log import read_metrics

_LAST = 20
"""Steps whose mean counts."""

OFF = {
    "all parts": {},
    "without classification": {"classification_weight": 0.0},
    "without L1": {"l1_weight": 0.0},
    "without velocity in L1": {"velocity_weight": 0.0},
    "without IoU": {"iou_weight": 0.0},
    "without IoU prediction": {"iou_prediction_weight": 0.0},
}
FIGURES = {
    "without classification": "mAP",
    "without L1": "orientation error, rad",
    "without velocity in L1": "velocity error, m/s",
    "without IoU": "IoU of positives",
    "without IoU prediction": "cross-entropy of predicted IoU",
}
HIGHER_IS_BETTER = ("mAP", "IoU of positives")


@dataclasses.dataclass(frozen=True)
class Args:
    """How long, and where the figures go."""

    frames: int = 6
    """Simulated frames, trained on and detected in."""
    steps: int = 240
    """Updates a run."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the weights."""
    runs: Path = Path("outputs/loss_parts")
    """Folder of the runs."""
    out: Path = Path("outputs/loss_parts.json")
    """Where the figures go."""


def run(name: str, config: Config, seed: int, args: Args) -> dict[str, float]:
    """Train once; the figures."""
    frames = SimulatedFrames(load_sensor(config.sensor), args.frames)
    folder = args.runs / f"{name.replace(' ', '_')}_{seed}"
    detector = trained(folder, config, frames, steps=args.steps, seed=seed)
    summary = evaluate_frames(*detections(detector, frames), metric_of(config.classes)).summary
    records = read_metrics(folder)

    def last(name: str) -> float:
        return float(np.mean([record[name] for record in records[-_LAST:]]))

    return {
        "mAP": summary["mean_ap"],
        "orientation error, rad": summary["tp_errors"]["orient_err"],
        "velocity error, m/s": summary["tp_errors"]["vel_err"],
        "IoU of positives": last("positive_iou"),
        "cross-entropy of predicted IoU": last("loss/iou_prediction"),
    }


def main(args: Args) -> None:
    """All runs, a line each, and the file."""
    base, _ = fresh_streets(QUICKSTART, steps=args.steps)
    runs: dict[str, list[dict[str, float]]] = {}
    for name, changes in OFF.items():
        config = dataclasses.replace(base, loss=dataclasses.replace(base.loss, **changes))
        runs[name] = [run(name, config, seed, args) for seed in args.seeds]
        print(name, json.dumps({k: [round(r[k], 3) for r in runs[name]] for k in runs[name][0]}), flush=True)
    verdicts = {}
    for name, figure in FIGURES.items():
        sign = 1 if figure in HIGHER_IS_BETTER else -1
        with_part, without = ([round(r[figure], 4) for r in runs[which]] for which in ("all parts", name))
        worse = min(sign * v for v in with_part) > max(sign * v for v in without)
        verdicts[name] = {"figure": figure, "all parts": with_part, "without": without, "worse in all": worse}
    options = {"frames": args.frames, "steps": args.steps, "seeds": list(args.seeds)}
    save({**options, "parts": verdicts}, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
