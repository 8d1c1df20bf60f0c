"""Does bfloat16 train as well as float32? The demo's training, somewhat shorter, three seeds each.

    python experiments/mixed_precision.py

Prints, for every seed and precision, the mean loss over each tenth of the training and the mAP on the demo's 40
unseen frames, and the difference between the precisions with a 95 % interval over the seeds (Student's t, seed by
seed). A run that was stopped goes on with the same command. Cost: forty minutes on one CPU core; XLA gains nothing
from bfloat16 there. Expected: the interval of the difference holds zero.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import tyro
from hardware import hardware
from scipy.stats import t

from fcos_lidar_jax.commands.demo import Demo, summarise
from fcos_lidar_jax.commands.runs import Rhythm
from fcos_lidar_jax.commands.simulated import SimulatedTraining, on_fresh_streets, unseen_frames
from fcos_lidar_jax.config import QUICKSTART
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.records import read_records
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots

Precision = Literal["float32", "bfloat16"]
_PARTS = 10


@dataclasses.dataclass(frozen=True)
class Args:
    """How long, and where to."""

    steps: int = 1500
    """Of every run."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run each."""
    test_frames: int = Demo.test_frames
    """Unseen; default: the demo's."""
    runs: Path = Path("outputs/mixed_precision")
    """Folder of the runs."""
    out: Path = Path("outputs/mixed_precision/result.json")
    """Where the figures go."""


def run(precision: Precision, seed: int, args: Args) -> dict[str, Any]:
    """Train and evaluate once."""
    config = on_fresh_streets(QUICKSTART)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, precision=precision))
    training = SimulatedTraining(
        args.runs / f"{precision}_{seed}",
        config,
        steps=args.steps,
        seed=seed,
        rhythm=Rhythm(save_every=-(-args.steps // 5), evaluate_every=args.steps),
        tests=None,
    )
    training.train()
    variables = load_checkpoint(Snapshots(training.run.folder / CHECKPOINTS).paths()[-1]).variables
    tests = unseen_frames(load_sensor(config.sensor), args.test_frames)
    frames = [tests.frame(i) for i in range(len(tests))]
    found = [training.run.detections(variables, frame) for frame in frames]
    losses = [r["loss/total"] for r in read_records(training.run.folder) if "loss/total" in r]
    return {
        "mAP": round(summarise(found, frames)["mAP"], 4),
        "loss by tenths": [round(float(np.mean(part)), 3) for part in np.array_split(losses, _PARTS)],
    }


def main(args: Args) -> None:
    """All runs, a line each, the verdict, the file."""
    results: dict[str, list[dict[str, Any]]] = {precision: [] for precision in get_args(Precision)}
    for seed in args.seeds:
        for precision, done in results.items():
            done.append(run(precision, seed, args))  # type: ignore[arg-type]
            print(precision, "seed", seed, json.dumps(done[-1]), flush=True)
    single, half = (np.array([r["mAP"] for r in results[p]]) for p in ("float32", "bfloat16"))
    differences = half - single
    count = len(differences)
    spread = float(np.std(differences, ddof=1) / np.sqrt(count)) if count > 1 else float("nan")
    reach = float(t.ppf(0.975, count - 1)) * spread if count > 1 else float("nan")
    mean = float(differences.mean())
    losses = {p: np.mean([r["loss by tenths"] for r in results[p]], axis=0) for p in results}
    record = {
        "steps": args.steps,
        "seeds": list(args.seeds),
        **results,
        "mAP, bfloat16 minus float32": {
            "mean": round(mean, 4),
            "interval": [round(mean - reach, 4), round(mean + reach, 4)],
        },
        "loss by tenths, bfloat16 over float32": (losses["bfloat16"] / losses["float32"]).round(4).tolist(),
        **hardware(),
    }
    print(json.dumps({k: v for k, v in record.items() if "bfloat16 " in k}))
    write_beside(args.out, lambda path: path.write_text(json.dumps(record, indent=1)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
