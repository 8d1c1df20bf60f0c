"""What does it learn from the 40 real keyframes of one scene?

    python experiments/real_scene.py --data FOLDER

FOLDER (default: the environment's ``FCOS_LIDAR_REAL_DATA``) holds ``nuscenes_scene0523/``. One sweep, the
quickstart's network on the full 32x1086 image. Two questions:

The ladder: 1, 4 and 32 keyframes without augmentation, and the 32 with it; mAP on the training frames themselves,
and the samples seen. A rung that is not learnt is a defect.

The transfer: keyframes 3 to 10 (0-based) are the test, the other 32 the training. Three models: trained on the 32
(the ladder's last rung), trained on simulated streets alone, and trained on those first, then on the 32. Training
and test share one scene, so the figures are in-scene ones, and the bootstrap intervals over eight keyframes that
resemble each other are too narrow.

mAP is the mean over the classes that occur. A run that was stopped goes on with the same command. Cost: about an
hour on two CPU cores.
"""

import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from hardware import hardware

from fcos_lidar_jax.commands.demo import summarise
from fcos_lidar_jax.commands.runs import Plan, Rhythm, Run
from fcos_lidar_jax.config import QUICKSTART, AugmentConfig, Config
from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.build import build_index
from fcos_lidar_jax.data.nuscenes.index import save_index
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.data.pipeline import make_batches
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots
from fcos_lidar_jax.types import CLASSES

VERSION = "v1.0-scene0523"
TEST = range(3, 11)
TRAIN = [i for i in range(40) if i not in TEST]
ENOUGH_TRUTHS = 10

CONFIG = dataclasses.replace(
    QUICKSTART,
    name="real_scene",
    sensor=SENSOR.name,
    max_points=40_960,
    max_boxes=160,
    copy_paste=None,
    class_balanced=False,
    augment=None,
    loss=dataclasses.replace(QUICKSTART.loss, l1_weight=1.0),
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=1),
)
"""The quickstart on the real sensor, one frame a step."""


@dataclasses.dataclass(frozen=True)
class Args:
    """What to train on, and how long."""

    data: Path | None = None
    """Folder with nuscenes_scene0523/; default: the environment's FCOS_LIDAR_REAL_DATA."""
    steps: tuple[int, int, int, int] = (300, 800, 1000, 1000)
    """Updates of the ladder's rungs."""
    simulated_steps: int = 1000
    """Updates on simulated streets."""
    fine_tuning_steps: int = 500
    """Updates on real frames after them."""
    only: tuple[str, ...] = ()
    """Of the runs, by name; default: all."""
    seed: int = 0
    """Of all runs."""
    runs: Path = Path("outputs/real_scene")
    """Folder of the runs."""
    out: Path = Path("outputs/real_scene/result.json")
    """Where the figures go."""


def real_frames(folder: Path, index: Path) -> NuScenesFrames:
    """The 40 keyframes, one sweep each."""
    root = folder / "nuscenes_scene0523"
    tables = root / VERSION
    save_index(build_index(tables), index, tables=tables)
    data = NuScenes(root, VERSION, index=index)
    return NuScenesFrames(data, tuple(data.split("scene0523")), num_sweeps=1)


def train(
    folder: Path, config: Config, frames: FrameSet, steps: int, seed: int, weights: Variables | None = None
) -> Run:
    """A run to its end; what is there already is not trained again."""
    plan = Plan(config, SENSOR, steps, seed, {"frames": len(frames), "first": frames.name(0)})
    run = Run(folder, plan, Rhythm(save_every=200, evaluate_every=steps), tests=None)

    def feed(first_step: int) -> Any:
        return make_batches(frames, config, seed=seed, num_steps=steps, first_step=first_step, threads=1)

    run.train(feed, resume=(folder / "run.json").exists(), weights=weights)
    return run


def trained(run: Run) -> Variables:
    """The weights at the end of a run."""
    return load_checkpoint(Snapshots(run.folder / CHECKPOINTS).paths()[-1]).variables


def scores(run: Run, frames: FrameSet) -> dict[str, Any]:
    """How well a run's detector does on frames, with an interval over them."""
    read = [frames.frame(i) for i in range(len(frames))]
    variables = trained(run)
    found = [run.detections(variables, frame) for frame in read]
    evaluation = evaluate_frames(found, read)
    truths = {name: len(r.truth_sample) for name, r in zip(CLASSES, evaluation.rankings, strict=True)}
    aps = evaluation.summary["mean_dist_aps"]
    often = [name for name in CLASSES if truths[name] >= ENOUGH_TRUTHS]
    return {
        "mAP": round(summarise(found, read)["mAP"], 4),
        "interval of the official mAP": {
            k: round(v, 4) for k, v in bootstrap(evaluation.rankings, len(read), repeats=1000)["mean_ap"].items()
        },
        "official mAP": round(evaluation.summary["mean_ap"], 4),
        f"mean AP of classes with {ENOUGH_TRUTHS} truths": round(float(np.mean([aps[name] for name in often])), 4),
        "AP": {name: round(aps[name], 4) for name in CLASSES if truths[name]},
        "truths": truths,
    }


def main(args: Args) -> None:
    """Train, evaluate, print, write."""
    folder = args.data or os.environ.get("FCOS_LIDAR_REAL_DATA")
    if not folder:
        sys.exit("error: --data: missing, expected the folder that holds nuscenes_scene0523/")
    with tempfile.TemporaryDirectory() as index:
        frames = real_frames(Path(folder), Path(index))
        run_all(args, frames)


def run_all(args: Args, frames: NuScenesFrames) -> None:
    """All runs, one after the other."""

    def some(numbers: list[int]) -> NuScenesFrames:
        return dataclasses.replace(frames, tokens=tuple(frames.tokens[i] for i in numbers))

    test, every = some(list(TEST)), some(TRAIN)
    augmented = dataclasses.replace(CONFIG, augment=AugmentConfig())
    streets = SimulatedFrames(SENSOR, args.simulated_steps, num_objects=40, reach_m=40.0, min_points=1)
    plans: dict[str, tuple[Config, FrameSet, int]] = {
        "1 frame": (CONFIG, some([20]), args.steps[0]),
        "4 frames": (CONFIG, some([0, 13, 26, 39]), args.steps[1]),
        "32 frames": (CONFIG, every, args.steps[2]),
        "32 frames, augmented": (augmented, every, args.steps[3]),
        "simulated": (augmented, streets, args.simulated_steps),
        "simulated, then 32 frames, augmented": (augmented, every, args.fine_tuning_steps),
    }

    def run_of(name: str) -> Run:
        config, shown, steps = plans[name]
        weights = trained(run_of("simulated")) if name.startswith("simulated,") else None
        return train(
            args.runs / name.replace(", ", "_").replace(" ", "_"), config, shown, steps, args.seed, weights
        )

    for name in args.only or plans:
        _, shown, steps = plans[name]
        run = run_of(name)
        found: dict[str, Any] = {"samples_seen": steps}
        if shown is not streets:
            found["training frames"] = scores(run, shown)
        if len(shown) >= len(TRAIN):
            found["test frames, in-scene"] = scores(run, test)
        record = json.loads(args.out.read_text()) if args.out.exists() else {}
        record |= {name: found, **hardware()}
        short = {k: v["mAP"] if isinstance(v, dict) else v for k, v in found.items()}
        print(f"{name}: {json.dumps(short)}", flush=True)
        text = json.dumps(record, indent=1)
        write_beside(args.out, lambda path, text=text: path.write_text(text))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
