"""What does it learn from the 40 real keyframes of one scene?

    python -m experiments.studies.real_scene --data FOLDER

FOLDER holds ``nuscenes_scene0523/``. One sweep, the quickstart's network on the full 32x1086 image.

1, 4 and 32 keyframes without augmentation, and the 32 with it; mAP on the training frames themselves, and the
samples seen. One of these steps that is not learnt is a defect. Those trained on the 32 are tested on the other
keyframes, 3 to 10 (0-based), too: training and test share one scene, and the bootstrap intervals over eight
keyframes that resemble each other are too narrow. What weights from simulated streets give: ``transfer.py``.

mAP is the mean over the classes that occur. The same command resumes a stopped run. Cost: an hour on two CPU
cores.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.changes import change
from experiments.runs import benchmark, detections, trained
from experiments.script import real_data, run_script, save
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import AugmentConfig, Config
from fcos_lidar_jax.data.frame import FrameSet, SelectedFrames
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR

TEST = range(3, 11)
TRAIN = [i for i in range(40) if i not in TEST]
ENOUGH_TRUTHS = 10

CONFIG = change(
    name="real_scene",
    sensor=SENSOR.name,
    max_points=40_960,
    max_boxes=160,
    copy_paste=None,
    class_balanced=False,
    augment=None,
    # At the default 0.25 a nearly square object can settle a quarter turn off with its sides exchanged: there the
    # IoU is perfect and only the L1 loss objects.
    loss__l1_weight=1.0,
    optimizer__batch_size=1,
)(QUICKSTART)
"""The quickstart on the real sensor, one frame a step."""


@dataclasses.dataclass(frozen=True)
class Args:
    """What to train on, and how long."""

    data: Path | None = None  # Folder with nuscenes_scene0523/; default: the environment's FCOS_LIDAR_REAL_DATA.
    steps: tuple[int, int, int, int] = (300, 800, 1000, 1000)  # Updates of each training.
    only: tuple[str, ...] = ()  # Of the runs, by name; default: all.
    seed: int = 0  # Of all runs.
    runs: Path = Path("outputs/real_scene")  # Folder of the runs.
    out: Path = Path("outputs/real_scene.json")  # Where the figures go.


def _scores(detector: TrainedDetector, frames: FrameSet) -> dict[str, Any]:
    found, read = detections(detector, frames)
    evaluation = benchmark(found, read)
    truths = {name: len(r.truth_sample) for name, r in zip(NUSCENES_CLASSES, evaluation.rankings, strict=True)}
    aps, interval = evaluation.summary["mean_dist_aps"], bootstrap(evaluation, repeats=1000)["mean_ap"]
    often = [aps[name] for name in NUSCENES_CLASSES if truths[name] >= ENOUGH_TRUTHS]
    return {
        "mAP": round(evaluate_frames(found, read, metric_of(NUSCENES_CLASSES)).summary["mean_ap"], 4),
        "interval of the official mAP": {k: round(v, 4) for k, v in interval.items()},
        "official mAP": round(evaluation.summary["mean_ap"], 4),
        f"mean AP of classes with {ENOUGH_TRUTHS} truths": round(float(np.mean(often)), 4),
        "AP": {name: round(aps[name], 4) for name in NUSCENES_CLASSES if truths[name]},
        "truths": truths,
    }


def main(args: Args) -> None:
    """Train, evaluate, print, write: one run after the other."""
    root = real_data(args.data, "nuscenes_scene0523")
    frames = open_frames(root, split="scene0523", num_sweeps=1, reading=CONFIG.reading)
    test, every = (SelectedFrames(frames, tuple(chosen)) for chosen in (TEST, TRAIN))
    augmented = change(augment=AugmentConfig())(CONFIG)
    runs: dict[str, tuple[Config, FrameSet, int]] = {
        "1 frame": (CONFIG, SelectedFrames(frames, (20,)), args.steps[0]),
        "4 frames": (CONFIG, SelectedFrames(frames, (0, 13, 26, 39)), args.steps[1]),
        "32 frames": (CONFIG, every, args.steps[2]),
        "32 frames, augmented": (augmented, every, args.steps[3]),
    }

    if unknown := set(args.only) - set(runs):
        raise ValueError(f"--only: got {sorted(unknown)[0]!r}, expected some of {', '.join(map(repr, runs))}")
    record = json.loads(args.out.read_text(encoding="utf-8")) if args.out.exists() else {}
    for name in args.only or runs:
        config, shown, steps = runs[name]
        folder = args.runs / name.replace(", ", "_").replace(" ", "_")
        detector = trained(folder, config, shown, steps=steps, seed=args.seed)
        found: dict[str, Any] = {"samples_seen": steps, "training frames": _scores(detector, shown)}
        if len(shown) >= len(TRAIN):
            found["test frames, in-scene"] = _scores(detector, test)
        short = {k: v["mAP"] if isinstance(v, dict) else v for k, v in found.items()}
        record[name] = found
        save(record, args.out, f"{name}: {json.dumps(short)}")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
