"""Does bfloat16 train as well as float32? The demo's training, somewhat shorter, three seeds each.

    python -m experiments.studies.mixed_precision

Prints, for every seed and precision, the mean loss over each tenth of the training and the mAP on 40 unseen
frames, and the difference between the precisions with a 95 % interval over the seeds (Student's t, seed by seed).
The same command resumes a stopped run. Cost: forty minutes on one CPU core, where bfloat16 is no faster. Expected:
the interval of the difference holds zero.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.changes import change
from experiments.runs import trained
from experiments.script import Options, run_measurement
from experiments.statistics import interval
from fcos_lidar_jax.inference.prediction import evaluate
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.simulation.frame_set import fresh_streets, unseen_frames
from fcos_lidar_jax.training.metrics_log import read_metrics

PRECISIONS = ("float32", "bfloat16")
_PARTS = 10


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How long."""

    steps: int = 1500  # Of every run.
    seeds: tuple[int, ...] = (0, 1, 2)  # One run each.
    test_frames: int = 40  # Unseen; default: the demo's.
    runs: Path = Path("outputs/mixed_precision")  # Folder of the runs.


def _run(precision: str, seed: int, args: Args) -> dict[str, Any]:
    config, frames = fresh_streets(QUICKSTART, steps=args.steps, seed=seed)
    config = change(model__precision=precision)(config)
    folder = args.runs / f"{precision}_{seed}"
    detector = trained(folder, config, frames, steps=args.steps, seed=seed)
    score = evaluate(detector, unseen_frames(detector.sensor, args.test_frames)).summary["mean_ap"]
    losses = [line["loss/total"] for line in read_metrics(folder) if "loss/total" in line]
    tenths = [round(float(np.mean(part)), 3) for part in np.array_split(losses, _PARTS)]
    return {"mAP": round(score, 4), "loss by tenths": tenths}


def measure(args: Args) -> dict[str, Any]:
    """All runs, a line each, and the differences."""
    results: dict[str, list[dict[str, Any]]] = {precision: [] for precision in PRECISIONS}
    for seed in args.seeds:
        for precision, done in results.items():
            done.append(_run(precision, seed, args))
            print(precision, "seed", seed, json.dumps(done[-1]), flush=True)
    single, half = (np.array([r["mAP"] for r in results[p]]) for p in PRECISIONS)
    losses = {p: np.mean([r["loss by tenths"] for r in results[p]], axis=0) for p in PRECISIONS}
    found = interval((half - single).tolist())
    bounds = found and [round(bound, 4) for bound in found[1:]]
    return {
        "steps": args.steps,
        "seeds": list(args.seeds),
        **results,
        "mAP, bfloat16 minus float32": {"mean": round(float((half - single).mean()), 4), "interval": bounds},
        "loss by tenths, bfloat16 over float32": (losses["bfloat16"] / losses["float32"]).round(4).tolist(),
    }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__, lambda r: json.dumps({k: r[k] for k in r if "bfloat16 " in k}))
