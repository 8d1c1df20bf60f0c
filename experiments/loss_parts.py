"""What is each part of the loss for? Trained without it, the figure it exists for gets worse.

    python experiments/loss_parts.py

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
from typing import Any

import jax
import numpy as np
import tyro
from hardware import hardware

from fcos_lidar_jax.commands.clouds import make_cloud
from fcos_lidar_jax.commands.simulated import on_fresh_streets
from fcos_lidar_jax.config import QUICKSTART, Config
from fcos_lidar_jax.data.pipeline import make_batches
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.training import fit, make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.loop import Record

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
    out: Path = Path("outputs/loss_parts.json")
    """JSON file."""


def run(config: Config, seed: int, args: Args) -> dict[str, float]:
    """Train once; the figures."""
    sensor = load_sensor(config.sensor)
    frames = SimulatedFrames(sensor, args.frames)
    detector = build_detector(config, sensor)
    optimizer = make_optimizer(config.optimizer, args.steps)
    key = jax.random.key(seed)
    records: list[Record] = []
    with make_batches(frames, config, seed=seed, num_steps=args.steps, first_step=0, threads=1) as batches:
        state = fit(
            jax.jit(make_train_step(detector, config, sensor, optimizer), donate_argnums=0),
            make_state(detector.init(key), optimizer, key),
            batches,
            num_steps=args.steps,
            report=lambda _, record: records.append(record),
        )
    detect = jax.jit(make_detect(detector, config, sensor))
    variables = {"params": state.params, "batch_stats": state.batch_stats}
    read = [frames.frame(i) for i in range(len(frames))]
    clouds = [make_cloud(frame.points, sensor, size=config.max_points, remove="none") for frame in read]
    found = [jax.tree.map(np.asarray, detect(variables, cloud.points, cloud.valid)) for cloud in clouds]
    summary = evaluate_frames(found, read).summary

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
    base = on_fresh_streets(QUICKSTART)
    runs: dict[str, list[dict[str, float]]] = {}
    for name, changes in OFF.items():
        config = dataclasses.replace(base, loss=dataclasses.replace(base.loss, **changes))
        runs[name] = [run(config, seed, args) for seed in args.seeds]
        print(name, json.dumps({k: [round(r[k], 3) for r in runs[name]] for k in runs[name][0]}), flush=True)
    verdicts = {}
    for name, figure in FIGURES.items():
        sign = 1 if figure in HIGHER_IS_BETTER else -1
        with_part, without = ([round(r[figure], 4) for r in runs[which]] for which in ("all parts", name))
        worse = min(sign * v for v in with_part) > max(sign * v for v in without)
        verdicts[name] = {"figure": figure, "all parts": with_part, "without": without, "worse in all": worse}
        print(name, json.dumps(verdicts[name]), flush=True)
    record: dict[str, Any] = {
        **{k: v for k, v in dataclasses.asdict(args).items() if k != "out"},
        "parts": verdicts,
        **hardware(),
    }
    write_beside(args.out, lambda path: path.write_text(json.dumps(record, indent=1)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
