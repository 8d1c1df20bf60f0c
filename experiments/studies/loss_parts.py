"""What is each part of the loss for? Trained without it, the figure it exists for gets worse.

    python -m experiments.studies.loss_parts

Overfits a few simulated frames with the quickstart, once with all parts and once without each, and detects on the
same frames. Per part one figure, from three seeds each; those of the IoU are of the positives in the last steps.
Cost: about half an hour on one CPU core. Expected: every "off" is worse than "all parts" in its own figure.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.changes import change
from experiments.runs import trained
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference.prediction import evaluate
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames, fresh_streets
from fcos_lidar_jax.training.metrics_log import read_metrics

_LAST = 20  # Steps whose mean counts.

PARTS = {
    "classification": ("classification_weight", "mAP"),
    "L1": ("l1_weight", "orientation error, rad"),
    "velocity in L1": ("velocity_weight", "velocity error, m/s"),
    "IoU": ("iou_weight", "IoU of positives"),
    "IoU prediction": ("iou_prediction_weight", "cross-entropy of predicted IoU"),
}
"""Part -> its weight, and the figure that it exists for."""
HIGHER_IS_BETTER = ("mAP", "IoU of positives")


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How long."""

    frames: int = 6  # Simulated frames, trained on and detected in.
    steps: int = 240  # Updates a run.
    seeds: tuple[int, ...] = (0, 1, 2)  # Of the weights.
    runs: Path = Path("outputs/loss_parts")  # Folder of the runs.


def _run(name: str, config: Config, seed: int, args: Args) -> dict[str, float]:
    frames = SimulatedFrames(load_sensor(config.sensor), args.frames)
    folder = args.runs / f"{name.replace(' ', '_')}_{seed}"
    summary = evaluate(trained(folder, config, frames, steps=args.steps, seed=seed), frames).summary
    last, errors = read_metrics(folder)[-_LAST:], summary["tp_errors"]
    return {
        "mAP": summary["mean_ap"],
        "orientation error, rad": errors["orient_err"],
        "velocity error, m/s": errors["vel_err"],
        "IoU of positives": float(np.mean([record["positive_iou"] for record in last])),
        "cross-entropy of predicted IoU": float(np.mean([record["loss/iou_prediction"] for record in last])),
    }


def measure(args: Args) -> dict[str, Any]:
    """All runs, a line each, and what they say of the parts."""
    base, _ = fresh_streets(QUICKSTART, steps=args.steps)
    runs: dict[str, list[dict[str, float]]] = {}
    off = {"all parts": {}, **{f"without {part}": {f"loss__{weight}": 0.0} for part, (weight, _) in PARTS.items()}}
    for name, changes in off.items():
        runs[name] = [_run(name, change(**changes)(base), seed, args) for seed in args.seeds]
        print(name, json.dumps({k: [round(r[k], 3) for r in runs[name]] for k in runs[name][0]}), flush=True)
    verdicts = {}
    for part, (_, figure) in PARTS.items():
        sign, name = 1 if figure in HIGHER_IS_BETTER else -1, f"without {part}"
        with_part, without = ([round(r[figure], 4) for r in runs[which]] for which in ("all parts", name))
        worse = min(sign * v for v in with_part) > max(sign * v for v in without)
        verdicts[name] = {"figure": figure, "all parts": with_part, "without": without, "worse in all": worse}
    return {"frames": args.frames, "steps": args.steps, "seeds": list(args.seeds), "parts": verdicts}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
