"""Training, export and scores of the weights in the package.

    python -m experiments.studies.shipped_weights --name hdl32e --work outputs/hdl32e
    python -m experiments.studies.shipped_weights --name hdl32e --work outputs/hdl32e --export
    python -m experiments.studies.shipped_weights --name quickstart  # scores the weights in the package

``hdl32e`` is the preset ``compact`` for nuScenes' sensor, ``hdl64e`` the preset ``kitti_compact`` for the view of
KITTI's camera, ``quickstart`` the preset of the same name. All are trained on simulated streets only, by default
each frame on another street. The training runs at low priority and saves every few minutes; the same command
resumes it with bit-identical results.

``--export`` does not train: it writes the averaged weights of the newest checkpoint into the package as float16,
scores them on unseen frames, and writes ``experiments/results/NAME.json`` and the model card; a training may run
at the same time. The class logits of ``hdl32e`` are adjusted for the class frequencies of nuScenes. Without
``--work``, the weights in the package are only scored. If the folder of the run is lost,
``--work NEW --warm-start hdl32e --seed 2`` starts a new one-cycle schedule from the weights in the package, on
streets from ``seed * frames``; choose a seed whose streets no earlier training used.

    python -m experiments.studies.shipped_weights --name hdl32e --work outputs/hdl32e --steps 15000 --seed 1 \
        --batch-size 4 --learning-rate 4e-3 --simulators 12 --workers 3  # on a GPU

``--second-look`` trains only the second look, with the detector of ``--warm-start`` frozen. Its boxes are found
once per frame and kept in the folder of the run, a megabyte per frame; each frame is then used twelve times:

    python -m experiments.studies.shipped_weights --name hdl32e --work outputs/second_look --warm-start hdl32e \
        --second-look --seed 4 --steps 38400

With ``--simulators``, that many processes simulate streets, from ``seed * 100,000`` on, and the steps repeat the
streets that there are. Such a run resumes, but not bit for bit, and does not pause for evaluations.

Cost: half a second to three seconds per step on two CPU cores, so hours in total; 13,429 steps of four
frames took 568 s on an H200. Expected: an mAP of at least 0.6 for quickstart.
"""

import dataclasses
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.cached import CachedFrames
from experiments.changes import change
from experiments.hardware import hardware
from experiments.pool import PooledFrames, simulating
from experiments.runs import detections, trained
from experiments.script import Options, compact_json, run_script, save
from experiments.second_look import USES, look_again, look_config
from experiments.studies.model_card import RESULTS, SHIPPED, write_card
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.checkpoints import load_checkpoint, save_checkpoint
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS
from fcos_lidar_jax.checkpoints.storage import Checkpoint, read_description
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.frame import Frame, FrameSet, SelectedFrames, WrappedFrames
from fcos_lidar_jax.data.nuscenes.names import TO_KITTI
from fcos_lidar_jax.evaluation.bootstrap import bootstrap
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import metric_of
from fcos_lidar_jax.files import atomic_write, read_json
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.models import count_parameters
from fcos_lidar_jax.presets import COMPACT, KITTI_COMPACT, QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames, fresh_streets
from fcos_lidar_jax.simulation.streets import CITY
from fcos_lidar_jax.simulation.world import class_shares
from fcos_lidar_jax.training import Schedule
from fcos_lidar_jax.training.metrics_log import read_metrics

_FRESH = change(copy_paste=None, class_balanced=False)  # Not needed with unlimited frames.
CONFIGS = {
    "quickstart": change(augment=None, optimizer__ema_decay=0.999)(_FRESH(QUICKSTART)),
    # Mirrored or rotated streets would face backwards and have other blind arcs.
    "hdl32e": change(
        augment__flip_y_probability=0.0,
        augment__max_rotation_rad=math.radians(3),
        optimizer__warmup_fraction=0.2,
        refinement__first_score_weight=0.5,  # better in real sweeps, see ``experiments/LOG.md``, 2026-11-28
    )(_FRESH(COMPACT)),
    # Simulated streets have y ahead.
    "hdl64e": change(
        augment__flip_x_probability=0.5,
        augment__flip_y_probability=0.0,
        optimizer__warmup_fraction=0.2,
    )(_FRESH(KITTI_COMPACT)),
}
EVEN_CITY = dataclasses.replace(CITY, name="city, more even", city_classes=0.25)
"""At the frequencies of a city, most classes would hardly occur; here each has at least a tenth of the mean."""
TRAINING_CITY = dataclasses.replace(
    EVEN_CITY,
    name="city, more even and glossy",
    gloss=1.0,
    patchwork=0.4,
    walls=0.35,
    bends=0.03,
    depots=0.5,
)
"""Real cars have fewer points than a city's matt cars, so the gloss differs per street. Real streets have longer
walls and buildings, and closer rows of trailers (``experiments/README.md``).
"""
_LOGIT_ADJUSTMENT = {"hdl32e": 0.5}  # See with_adjusted_logits and ``experiments/LOG.md``, 2026-11-27.
_MATT_PERIOD = 3
"""Every third street has matt cars, like the simulated drives of the tests. With ``--simulators`` it is about
every third, since each process simulates streets of one kind, and some are faster."""
_MORE_OBJECTS = 120  # Instead of 60: the time of a step hardly depends on the number of objects.
_NICE = 10
_CURVE_FRAMES = 40  # Unseen frames of evaluations during training.
_STREETS, _POOLED = "streets", "pool.json"  # Folder and record of repeated streets, in the folder of the run.
_LOOK = "second_look.json"  # Record of a second look.
_POOL = 100_000  # Streets to simulate at most, if they repeat.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the weights."""

    name: Literal["quickstart", "hdl32e", "hdl64e"]  # Weights to train or score.
    work: Path | None = None  # Folder of the training run; default: score the weights in the package.
    steps: int = 20_000  # Updates of the whole run.
    seed: int = 1  # Seed of weights and streets; the demo trains with 0.
    batch_size: int = 1  # Frames per update.
    learning_rate: float | None = None  # Peak of the schedule; default: the preset's, for one frame per update.
    simulators: int = 0  # Processes that simulate streets, which repeat; default: each frame is another street.
    workers: int = 0  # Processes that prepare batches, in addition to a thread.
    warm_start: Path | None = None  # Checkpoint or shipped weights to start from; default: random weights.
    second_look: bool = False  # Train only the second look, with the detector of --warm-start frozen.
    save_every: int = 150  # Steps between two checkpoints.
    export: bool = False  # Write the current weights into the package instead of training.
    test_frames: int = 200  # Unseen frames for the scores.


@dataclasses.dataclass(frozen=True)
class MixedFrames(WrappedFrames):
    """The frames of one set, except that every ``period``-th is the frame of the same index of another set.

    Everything else comes from the first set.
    """

    other: FrameSet
    period: int

    def frame(self, index: int) -> Frame:
        return (self.frames if index % self.period else self.other).frame(index)

    truth, labels = FrameSet.truth, FrameSet.labels

    def fingerprint(self) -> str:
        return f"{self.frames.fingerprint()}, every {self.period}: {self.other.fingerprint()}"


def streets(config: Config, *, steps: int, seed: int) -> tuple[FrameSet, FrameSet]:
    """Create training frames that are all different, and unseen test frames."""
    unseen = open_frames(format="simulated", split="val", sensor=load_sensor(config.sensor))
    assert isinstance(unseen, SimulatedFrames)
    fresh = fresh_streets(config, steps=steps, seed=seed)[1]
    shown = dataclasses.replace(unseen, number=fresh.number, first_seed=fresh.first_seed)
    if unseen.streets != CITY:
        return shown, unseen
    matt = dataclasses.replace(shown, num_objects=_MORE_OBJECTS, streets=EVEN_CITY)
    mixed = MixedFrames(dataclasses.replace(matt, streets=TRAINING_CITY), matt, _MATT_PERIOD)
    if config.classes == NUSCENES_CLASSES:
        return mixed, unseen
    return MappedFrames(mixed, config.classes, TO_KITTI), MappedFrames(unseen, config.classes, TO_KITTI)


def train(args: Args, work: Path) -> dict[str, Any]:
    """Start or resume the run and train to its end."""
    os.nice(_NICE)
    config = change(optimizer__batch_size=args.batch_size)(CONFIGS[args.name])
    if args.second_look:
        assert config.refinement is not None
        config = look_config(config, config.refinement, batch_size=args.batch_size)
    if args.learning_rate is not None:
        config = change(optimizer__peak_learning_rate=args.learning_rate)(config)
    # Rejects before hours of training what the export would reject, or leave out of the record.
    earlier = earlier_trainings(args.name, {"begun_with": str(args.warm_start), "seed": None})
    if not work.exists() and args.seed in (seeds := [training["seed"] for training in earlier]):
        raise ValueError(f"--seed: got {args.seed}, expected none of the earlier trainings, {seeds}")
    if args.second_look:
        return train_second_look(args, work, config)
    number = _POOL // config.optimizer.batch_size if args.simulators else args.steps
    frames, unseen = streets(config, steps=number, seed=args.seed)
    run = {"steps": args.steps, "seed": args.seed, "weights": args.warm_start, "workers": args.workers}
    if not args.simulators:
        schedule = Schedule(save_every=args.save_every, evaluate_every=-(-args.steps // 10))
        curve_frames = SelectedFrames(unseen, tuple(range(_CURVE_FRAMES)))
        trained(work, config, frames, **run, tests=curve_frames, schedule=schedule)
        return training_record(work)
    pool = CachedFrames(frames, work / _STREETS)
    schedule = Schedule(save_every=args.save_every)
    with simulating(pool, args.simulators):
        trained(work, config, PooledFrames(pool), **run, schedule=schedule)
    record = {"streets": len(pool.made()), "device": hardware()["device"]}
    atomic_write(work / _POOLED, compact_json(record) + "\n")
    return training_record(work)


def train_second_look(args: Args, work: Path, config: Config) -> dict[str, Any]:
    """Train a second look on the boxes of a frozen detector, and write its checkpoint and record."""
    assert args.warm_start is not None
    assert config.refinement is not None
    first, began = load_trained(args.warm_start), time.monotonic()
    frames, _ = streets(config, steps=max(args.steps // USES, 1), seed=args.seed)
    numbers = {"samples": len(frames), "updates": args.steps, "seed": args.seed}
    detector = look_again(first, config, frames, **numbers, folder=work / "boxes")
    checkpoint = Checkpoint(config, detector.sensor, detector.variables, args.steps)
    (work / CHECKPOINTS).mkdir(exist_ok=True)
    save_checkpoint(work / CHECKPOINTS / f"{args.steps:08d}", checkpoint)
    record = {
        "preset": config.name,
        "parameters": count_parameters(detector.variables["params"])["total"],
        "seed": args.seed,
        "begun_with": str(args.warm_start),
        "steps": args.steps,
        "frames_seen": len(frames),
        "seconds": round(time.monotonic() - began),
        "trained": "second look",
        "num_boxes": config.refinement.num_boxes,
        "num_points": config.refinement.num_points,
    }
    atomic_write(work / _LOOK, compact_json(record) + "\n")
    return record


def training_record(run: Path) -> dict[str, Any]:
    """Summarise the training of a run."""
    if (run / _LOOK).exists():
        return read_json(run / _LOOK, dict[str, Any])
    checkpoint, spec = load_checkpoint(run), read_json(run / "run.json", dict[str, Any])
    config, done = checkpoint.config, checkpoint.step
    records = [record for record in read_metrics(run) if record["step"] <= done]  # may go on after the checkpoint
    batch, pooled = config.optimizer.batch_size, run / _POOLED
    return {
        "preset": config.name,
        "parameters": count_parameters(checkpoint.variables["params"])["total"],
        "seed": spec["seed"],
        "begun_with": spec["weights"] or "random weights",
        "steps": done,
        "steps_planned": spec["steps"],
        "frames_seen": done * batch,
        "seconds_of_steps": round(sum(r.get("seconds", 0.0) for r in records)),
        "curve": [[r["step"] * batch, round(r["test/mAP"], 4)] for r in records if "test/mAP" in r],
        **(read_json(pooled, dict[str, Any]) if pooled.exists() else {}),
    }


def earlier_trainings(name: str, training: Mapping[str, Any]) -> list[dict[str, Any]]:
    """List the trainings before a warm start, as recorded by the last export."""
    file = RESULTS / f"{name}.json"
    if training["begun_with"] != name or not file.exists():
        return []
    before = read_json(file, dict[str, Any])
    if "training" not in before:
        raise ValueError(f"{file}: training: missing, expected that of the weights that this one started from")
    return [t for t in (*before["earlier"], before["training"]) if t["seed"] != training["seed"]]


def with_adjusted_logits(checkpoint: Checkpoint, share: float) -> Checkpoint:
    """Add a share of the log ratio of the class frequencies of nuScenes and of ``EVEN_CITY`` to the class logits.

    The training shows rare classes more often than nuScenes does, so their scores are too high relative to those
    of frequent classes (Menon et al., "Long-tail learning via logit adjustment", ICLR 2021).
    """
    seen, usual = class_shares(EVEN_CITY.city_classes), class_shares(1.0)
    added = np.append(share * np.log(usual / seen), 0.0).astype(np.float32)  # nothing for the background

    def adapt(path: tuple[Any, ...], leaf: np.ndarray) -> np.ndarray:
        return leaf + added if path[-1].key == "logits_bias" else leaf

    adapted = jax.tree_util.tree_map_with_path(adapt, checkpoint.variables)
    return dataclasses.replace(checkpoint, variables=adapted)


def with_todays_inference(checkpoint: Checkpoint, name: str) -> Checkpoint:
    """Replace the settings that the weights do not depend on by the preset's current ones: post-processing, and
    numbers of boxes and points of the second look, which was trained with those of its run.
    """
    config, today = checkpoint.config, CONFIGS[name]
    look = config.refinement
    if look is not None and today.refinement is not None:
        numbers = {n: getattr(today.refinement, n) for n in ("num_boxes", "num_points", "first_score_weight")}
        look = dataclasses.replace(look, **numbers, freeze_detector=False)
    config = dataclasses.replace(config, inference=today.inference, refinement=look)
    return dataclasses.replace(checkpoint, config=config)


def scores(args: Args) -> dict[str, Any]:
    """Score the weights in the package on unseen frames."""
    folder = SHIPPED / args.name
    detector = load_trained(folder)
    _, unseen = streets(detector.config, steps=1, seed=0)
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
    """Write the weights of the newest checkpoint and their model card; returns training and scores."""
    folder, training = SHIPPED / args.name, training_record(work)
    earlier = earlier_trainings(args.name, training)
    checkpoint = with_todays_inference(load_checkpoint(work), args.name)
    share = _LOGIT_ADJUSTMENT.get(args.name)
    if share and "trained" not in training:  # The logits of a frozen detector are adjusted already.
        checkpoint = with_adjusted_logits(checkpoint, share)
        training["logit_adjustment"] = share
    halved = jax.tree.map(lambda leaf: np.asarray(leaf, np.float16), checkpoint.variables)
    save_checkpoint(folder, dataclasses.replace(checkpoint, variables=halved))
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    record = {"bytes": size, "training": training, "earlier": earlier, **scores(args)}
    write_card(args.name, RESULTS, training=record)
    return record


def main(args: Args) -> None:
    """Score, train or export; the next export reads the record of this one."""
    if args.second_look and str(args.warm_start) != args.name:  # whose logits are adjusted
        raise ValueError(f"--second-look: got --warm-start {args.warm_start}, expected {args.name}")
    if args.second_look and (args.simulators or args.workers):
        raise ValueError("--simulators, --workers: expected none with --second-look")
    if args.work is None:
        if args != Args(name=args.name, test_frames=args.test_frames, out=args.out):
            raise ValueError("--work: missing, expected the folder of the training that the other options are for")
        save(scores(args), args.out)
        return
    record = export(args, args.work) if args.export else train(args, args.work)
    save(record, args.out or (RESULTS / f"{args.name}.json" if args.export else None))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
