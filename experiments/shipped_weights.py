"""The weights that come with the package: the quickstart preset, trained longer than the demo has time for.

    python experiments/shipped_weights.py

Trains on simulated streets, every frame another one, evaluates on the demo's 40 unseen frames and on 400 more, and
writes the checkpoint that ``fcos-lidar demo`` and ``--checkpoint quickstart`` use. The same command goes on where
it was stopped. Cost: hours on two CPU cores. Expected: mAP of at least 0.6 on the demo's frames.
"""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from hardware import hardware

from fcos_lidar_jax.commands.demo import summarise
from fcos_lidar_jax.commands.runs import Rhythm
from fcos_lidar_jax.commands.simulated import SimulatedTraining, on_fresh_streets, unseen_frames
from fcos_lidar_jax.config import QUICKSTART
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.training import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.training.records import read_records
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots

_DEMO_FRAMES = 40


@dataclasses.dataclass(frozen=True)
class Args:
    """How long, and where to."""

    steps: int = 15_000
    """Of training."""
    seed: int = 1
    """Of weights and streets; the demo trains with 0."""
    ema_decay: float = 0.999
    """Of the running mean of the weights, which is what is shipped."""
    test_frames: int = 440
    """Unseen; the first 40 are the demo's."""
    run: Path = Path("outputs/shipped_weights")
    """Folder of the training run."""
    weights: Path = Path("fcos_lidar_jax/weights/quickstart")
    """Where the checkpoint goes."""
    out: Path = Path("experiments/results/shipped_weights.json")
    """Where the figures go."""


def main(args: Args) -> None:
    """Train, evaluate, write."""
    config = on_fresh_streets(QUICKSTART)
    config = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, ema_decay=args.ema_decay))
    sensor = load_sensor(config.sensor)
    rhythm = Rhythm(save_every=-(-args.steps // 50), evaluate_every=-(-args.steps // 12))
    training = SimulatedTraining(
        args.run,
        config,
        steps=args.steps,
        seed=args.seed,
        rhythm=rhythm,
        tests=unseen_frames(sensor, _DEMO_FRAMES),
    )
    began = time.monotonic()
    training.train()
    trained = load_checkpoint(Snapshots(args.run / CHECKPOINTS).paths()[-1])
    tests = unseen_frames(sensor, args.test_frames)
    frames = [tests.frame(i) for i in range(len(tests))]
    found = [training.run.detections(trained.variables, frame) for frame in frames]
    of_demo = summarise(found[:_DEMO_FRAMES], frames[:_DEMO_FRAMES])
    rest, rest_found = frames[_DEMO_FRAMES:], found[_DEMO_FRAMES:]
    intervals = bootstrap(evaluate_frames(rest_found, rest).rankings, len(rest), repeats=1000)
    of_rest = summarise(rest_found, rest)
    records = read_records(args.run)
    record: dict[str, Any] = {
        "steps": trained.step,
        "frames_seen": trained.step * config.optimizer.batch_size,
        "seconds_of_steps": round(sum(r.get("seconds", 0.0) for r in records)),
        "minutes_of_this_call": round((time.monotonic() - began) / 60, 1),
        "mAP, demo's 40 frames": round(of_demo["mAP"], 4),
        f"mAP, {len(rest)} more frames": round(of_rest["mAP"], 4),
        "interval of it": intervals["mean_ap"],
        "AP": {name: round(float(np.mean(list(aps.values()))), 4) for name, aps in of_rest["AP"].items()},
        "curve, demo's frames": [[r["step"], round(r["test/mAP"], 4)] for r in records if "test/mAP" in r],
        **hardware(),
    }
    print(json.dumps(record, indent=1))
    args.weights.parent.mkdir(parents=True, exist_ok=True)
    save_checkpoint(
        args.weights,
        Checkpoint(config, sensor, trained.variables, trained.step, trained.data, round(of_demo["mAP"], 4)),
    )
    write_beside(args.out, lambda path: path.write_text(json.dumps(record, indent=1)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
