"""The weights that come with the package: the quickstart preset, trained longer than the demo has time for.

    python -m experiments.studies.shipped_weights

Trains on simulated streets, every frame another one, evaluates on the demo's 40 unseen frames and on 400 more, and
writes the checkpoint that ``fcos-lidar demo`` and ``--checkpoint quickstart`` use. The same command resumes a
stopped run. Cost: hours on two CPU cores. Expected: mAP of at least 0.6 on the demo's frames.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from experiments.changes import change
from experiments.runs import detections, trained
from experiments.script import Options, run_measurement
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.simulation.frame_set import fresh_streets, unseen_frames
from fcos_lidar_jax.trainer import Schedule
from fcos_lidar_jax.training import load_checkpoint, save_checkpoint
from fcos_lidar_jax.training.checkpoints import find_checkpoint
from fcos_lidar_jax.training.metrics_log import read_metrics

_DEMO_FRAMES = 40


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How long, and where to."""

    steps: int = 15_000  # Of training.
    seed: int = 1  # Of weights and streets; the demo trains with 0.
    ema_decay: float = 0.999  # Of the running mean of the weights, which is what is shipped.
    test_frames: int = 440  # Unseen; the first 40 are the demo's.
    run: Path = Path("outputs/shipped_weights")  # Folder of the training run.
    weights: Path = Path("fcos_lidar_jax/weights/quickstart")  # Where the checkpoint goes.


def measure(args: Args) -> dict[str, Any]:
    """Train, evaluate, write the checkpoint."""
    config, streets = fresh_streets(QUICKSTART, steps=args.steps, seed=args.seed)
    config = change(optimizer__ema_decay=args.ema_decay)(config)
    began = time.monotonic()
    tests = unseen_frames(streets.sensor, _DEMO_FRAMES)
    schedule = Schedule(save_every=-(-args.steps // 50), evaluate_every=-(-args.steps // 12))
    length = {"steps": args.steps, "seed": args.seed}
    detector = trained(args.run, config, streets, **length, tests=tests, schedule=schedule)
    found, frames = detections(detector, unseen_frames(streets.sensor, args.test_frames))
    metric, rest = metric_of(config.classes), slice(_DEMO_FRAMES, None)
    of_demo = evaluate_frames(found[:_DEMO_FRAMES], frames[:_DEMO_FRAMES], metric).summary["mean_ap"]
    of_rest = evaluate_frames(found[rest], frames[rest], metric)
    checkpoint, records = load_checkpoint(find_checkpoint(args.run)), read_metrics(args.run)
    args.weights.parent.mkdir(parents=True, exist_ok=True)
    save_checkpoint(args.weights, dataclasses.replace(checkpoint, score=round(of_demo, 4)))
    return {
        "steps": checkpoint.step,
        "frames_seen": checkpoint.step * config.optimizer.batch_size,
        "seconds_of_steps": round(sum(r.get("seconds", 0.0) for r in records)),
        "minutes_of_this_call": round((time.monotonic() - began) / 60, 1),
        "mAP, demo's 40 frames": round(of_demo, 4),
        f"mAP, {len(frames[rest])} more frames": round(of_rest.summary["mean_ap"], 4),
        "interval of it": bootstrap(of_rest, repeats=1000)["mean_ap"],
        "AP": {name: round(ap, 4) for name, ap in of_rest.summary["mean_dist_aps"].items()},
        "curve, demo's frames": [[r["step"], round(r["test/mAP"], 4)] for r in records if "test/mAP" in r],
    }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
