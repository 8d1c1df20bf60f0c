"""The weights that come with the package, trained on simulated streets alone.

    python -m experiments.studies.shipped_weights --name hdl32e --work outputs/hdl32e
    python -m experiments.studies.shipped_weights --name hdl32e --work outputs/hdl32e --export
    python -m experiments.studies.shipped_weights --name quickstart  # scores what is in the package

``hdl32e`` is the preset ``compact`` for nuScenes' sensor, ``quickstart`` the preset of that name. Every frame is
another street. The training runs at low priority and saves every few minutes; the same command resumes it, bit for
bit, after any kind of stop. ``--export`` trains nothing: it writes the running mean of the weights at the newest
checkpoint into the package, as float16, scores them on unseen frames, and writes ``experiments/results/NAME.json``
and their model card; another process may be training meanwhile. Without ``--work`` the weights in the package are
scored on unseen frames, and nothing else. Where the folder is lost, ``--work NEW --warm-start hdl32e --seed 2``
begins a new one-cycle schedule with the weights in the package, on streets ``seed * steps`` and on; choose a seed
whose streets none of the trainings before it had.

Cost: half a second to three seconds a step, that is hours, on two CPU cores. Expected: an mAP of at least 0.6
for quickstart.
"""

import dataclasses
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.changes import change
from experiments.runs import detections, trained
from experiments.script import Options, run_script, save
from experiments.studies.model_card import RESULTS, SHIPPED, write_card
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.checkpoints import load_checkpoint, save_checkpoint
from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.checkpoints.storage import Checkpoint, read_description
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import FrameSet, SelectedFrames
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.presets import COMPACT, QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames, fresh_streets
from fcos_lidar_jax.simulation.streets import CITY
from fcos_lidar_jax.training import Schedule
from fcos_lidar_jax.training.metrics_log import read_metrics

_FRESH = change(copy_paste=None, class_balanced=False)  # What makes more of few frames has no use here.
CONFIGS = {
    "quickstart": change(augment=None, optimizer__ema_decay=0.999)(_FRESH(QUICKSTART)),
    # No street is shown twice. A mirrored or turned one would look down behind, and have its blind arcs elsewhere.
    "hdl32e": change(
        augment__flip_y_probability=0.0,
        augment__max_rotation_rad=math.radians(3),
        optimizer__warmup_fraction=0.2,
    )(_FRESH(COMPACT)),
}
EVENER_CITY = dataclasses.replace(CITY, name="city, classes more even", city_classes=0.25)
"""Each class is a tenth of the mean, however rare; at a city's frequencies most are hardly ever trained."""
_MORE_OBJECTS = 120  # Of 60: what a step costs hardly depends on how many there are to learn from.
_MAX_BYTES = 8 * 2**20
_NICE = 10
_TESTS_ALONG = 40  # Unseen frames of the evaluations during training.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Which weights, how long, and where the run is."""

    name: Literal["quickstart", "hdl32e"]  # Weights to make.
    work: Path | None = None  # Folder of the training run; default: score the weights in the package.
    steps: int = 20_000  # Of the whole run.
    seed: int = 1  # Of weights and streets; the demo trains with 0.
    warm_start: Path | None = None  # Checkpoint or shipped weights to begin with; default: random ones.
    save_every: int = 150  # Steps between two checkpoints.
    export: bool = False  # Write the present weights into the package instead of training.
    test_frames: int = 200  # Unseen frames that the weights are scored on.


_OF_TRAINING = ("steps", "seed", "warm_start", "save_every", "export")  # Options of no use without ``work``.


def streets(config: Config, *, steps: int, seed: int) -> tuple[SimulatedFrames, FrameSet]:
    """Training frames of which none is shown twice, and unseen ones; in cities classes as frequent as there."""
    unseen = open_frames(format="simulated", split="val", sensor=load_sensor(config.sensor))
    assert isinstance(unseen, SimulatedFrames)
    fresh = fresh_streets(config, steps=steps, seed=seed)[1]
    shown = dataclasses.replace(unseen, number=fresh.number, first_seed=fresh.first_seed)
    if unseen.streets == CITY:
        shown = dataclasses.replace(shown, num_objects=_MORE_OBJECTS, streets=EVENER_CITY)
    return shown, unseen


def train(args: Args, work: Path) -> dict[str, Any]:
    """Begin the run, or go on with it, to the end."""
    os.nice(_NICE)
    config = CONFIGS[args.name]
    # What an export would refuse is refused before hours of training.
    earlier_trainings(args.name, {"begun_with": str(args.warm_start), "seed": args.seed}, RESULTS)
    frames, unseen = streets(config, steps=args.steps, seed=args.seed)
    schedule = Schedule(save_every=args.save_every, evaluate_every=-(-args.steps // 10))
    tests = SelectedFrames(unseen, tuple(range(_TESTS_ALONG)))
    length = {"steps": args.steps, "seed": args.seed}
    trained(work, config, frames, **length, tests=tests, schedule=schedule, weights=args.warm_start)
    return training_record(work)


def training_record(run: Path) -> dict[str, Any]:
    """What a run's records say about its training."""
    config = load_checkpoint(find_checkpoint(run)).config
    spec, records = read_json(run / "run.json", dict[str, Any]), read_metrics(run)
    done = max((r["step"] for r in records if "seconds" in r), default=0)
    batch = config.optimizer.batch_size
    return {
        "preset": config.name,
        "seed": spec["seed"],
        "begun_with": spec["weights"] or "random weights",
        "steps": done,
        "steps_planned": spec["steps"],
        "frames_seen": done * batch,
        "seconds_of_steps": round(sum(r.get("seconds", 0.0) for r in records)),
        "curve": [[r["step"] * batch, round(r["test/mAP"], 4)] for r in records if "test/mAP" in r],
    }


def earlier_trainings(name: str, training: Mapping[str, Any], results: Path) -> list[dict[str, Any]]:
    """The trainings that led to the weights that this one began with, as the last exports recorded them."""
    file = results / f"{name}.json"
    if training["begun_with"] != name or not file.exists():
        return []
    before = read_json(file, dict[str, Any])
    if "training" not in before:
        raise ValueError(f"{file}: training: missing, expected that of the weights that this one began with")
    return [t for t in (*before["earlier"], before["training"]) if t["seed"] != training["seed"]]


def half_precision(checkpoint: Checkpoint) -> Checkpoint:
    """The checkpoint with float16 weights, which are read as float32 again."""
    halved = jax.tree.map(lambda leaf: np.asarray(leaf, np.float16), checkpoint.variables)
    return dataclasses.replace(checkpoint, variables=halved)


def with_todays_inference(checkpoint: Checkpoint, name: str) -> Checkpoint:
    """The checkpoint with the preset's post-processing of today, which no training depends on."""
    config = dataclasses.replace(checkpoint.config, inference=CONFIGS[name].inference)
    return dataclasses.replace(checkpoint, config=config)


def scores(args: Args) -> dict[str, Any]:
    """What the weights in the package find in unseen frames."""
    folder = SHIPPED / args.name
    detector = load_trained(folder)
    _, unseen = streets(detector.config, steps=args.steps, seed=args.seed)
    found, frames = detections(detector, SelectedFrames(unseen, tuple(range(args.test_frames))))
    evaluation = evaluate_frames(found, frames, metric_of(detector.classes))
    return {
        "name": args.name,
        "hash": read_description(folder)["hash"],
        "unseen_frames": args.test_frames,
        "mAP": round(evaluation.summary["mean_ap"], 4),
        "interval": bootstrap(evaluation, repeats=1000)["mean_ap"],
        "AP": {name: round(ap, 4) for name, ap in evaluation.summary["mean_dist_aps"].items()},
    }


def export(args: Args, work: Path) -> dict[str, Any]:
    """Write the weights of the newest checkpoint and their card; returns training and scores."""
    folder, training = SHIPPED / args.name, training_record(work)
    earlier = earlier_trainings(args.name, training, RESULTS)
    checkpoint = with_todays_inference(load_checkpoint(find_checkpoint(work)), args.name)
    save_checkpoint(folder, half_precision(checkpoint))
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    if size > _MAX_BYTES:
        raise ValueError(f"{folder}: got {size} bytes, expected at most {_MAX_BYTES}")
    record = {"bytes": size, "training": training, "earlier": earlier, **scores(args)}
    write_card(args.name, RESULTS, training=record)
    return record


def main(args: Args) -> None:
    """Score, train, or export; the record of an export lies where the next one looks for those before it."""
    if args.work is None:
        if given := [name for name in _OF_TRAINING if getattr(args, name) != getattr(Args, name)]:
            raise ValueError(f"--{given[0].replace('_', '-')}: is of a training, expected its folder in --work")
        save(scores(args), args.out)
        return
    record = export(args, args.work) if args.export else train(args, args.work)
    save(record, args.out or (RESULTS / f"{args.name}.json" if args.export else None))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
