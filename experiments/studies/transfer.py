"""Transfer of a detector from simulated streets to real sweeps, without and with fine-tuning.

    python -m experiments.studies.transfer --data FOLDER
    python -m experiments.studies.transfer --checkpoint RUN --only simulated
    python -m experiments.studies.transfer --data FOLDER --only fine_tuning
    python -m experiments.studies.transfer --data FOLDER --only simulated --no-second-look --out without.json
    python -m experiments.studies.transfer --data FOLDER --mirrored --out mirrored.json

FOLDER contains ``nuscenes_scene0523/`` (40 keyframes of one street), ``nuscenes_scene0103/`` (two keyframes of
another) and ``nuscenes_scene0061/`` (one of a third). The simulated keyframes are of unseen drives, as written by
``fcos-lidar synthesize``. Average precision is by centre distance, as in nuScenes' benchmark, over all boxes with
a point within their class's range, and over boxes at 0-20 m and 20-40 m. Means are over the classes that occur;
simulated drives also have the official mAP and NDS. ``overlapping`` is the share of boxes of score 0.3 and more
that overlap such a box of another class on the ground. Bootstrap intervals resample simulated drives or real
keyframes; the latter are too narrow, because keyframes of a scene are similar.

Fine-tuning trains on 32 keyframes of scene-0523 from the checkpoint's weights, at a third of the learning rate,
and from random weights, with as many steps, and tests on the other eight. Both trainings have the checkpoint's
augmentation, because views that it never saw, such as mirrored streets, would have to be learned from few frames.
The same command resumes it. Cost: five minutes on two CPU cores, and one hour for fine-tuning.
"""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.changes import change
from experiments.real_frames import interval_of, real_frames, scores_by_range
from experiments.runs import detections, trained
from experiments.script import Options, real_data, run_script, save
from fcos_lidar_jax import open_frames
from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.checkpoints.storage import read_description
from fcos_lidar_jax.data.frame import FrameSet, SelectedFrames
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation.metrics import evaluate
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE
from fcos_lidar_jax.evaluation.results import LIDAR_META, read_results, result_entries
from fcos_lidar_jax.evaluation.truth import split_truth
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.iou import rotated_iou_bev
from fcos_lidar_jax.presets import COMPACT
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.types import Detections

REAL = ("scene-0523, even", "scene-0523, odd", "scene-0103", "scene-0061")
TEST = range(3, 11)  # Keyframes of scene-0523.
TRAIN = [i for i in range(40) if i not in TEST]
_OVERLAP = 0.1  # IoU on the ground from which two boxes stand for one object.
_REPEATS = 300  # Bootstrap samples of an interval.
_overlaps = jax.jit(lambda boxes: rotated_iou_bev(boxes[:, None], boxes[None]))


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    data: Path | None = None  # Folder of the real data; default: the environment's FCOS_LIDAR_REAL_DATA.
    checkpoint: Path = Path("hdl32e")  # Detector: a checkpoint, a run, or shipped weights.
    only: tuple[str, ...] = ()
    """Parts to measure: simulated, fine_tuning, "scene-0523, even", "scene-0523, odd", scene-0103, scene-0061;
    default: all."""
    scenes: int = 50  # Simulated drives.
    keyframes: int = 4  # Keyframes per drive.
    seed: int = 77  # Seed of the drives.
    second_look: bool = True  # Use the detector's second look, if it has one.
    mirrored: bool = False  # Detect in the view mirrored in x as well, which doubles the time.
    fine_tuning_steps: int = 1000  # Updates, each on one real keyframe.
    work: Path = Path("outputs/transfer")  # Folder of simulated drives and fine-tuning runs.


def simulated_drives(args: Args, sensor: Sensor) -> NuScenesFrames:
    """Write the simulated drives and open their keyframes."""
    spec = DatasetSpec(args.scenes, args.seed, args.keyframes, sensor, True, "v1.0-synthetic")
    root = args.work / f"drives_{args.scenes}_{args.keyframes}_{args.seed}"
    write_dataset(spec, root, workers=1, report=Progress("sweeps", spec.scenes * spec.sweeps).show)
    frames = open_frames(root, reading=cut_reading(1), sensor=sensor)
    assert isinstance(frames, NuScenesFrames)
    return frames


def parts(args: Args, detector: TrainedDetector) -> Iterator[tuple[str, FrameSet]]:
    """Open the selected data one after the other."""
    if not args.only or "simulated" in args.only:
        yield "simulated", simulated_drives(args, detector.sensor)
    if not args.only or {*args.only} & {*REAL}:
        real = real_frames(args.data, detector.config.reading)
        yield from ((name, real[name]) for name in args.only or REAL if name in real)


def applied(args: Args, detector: TrainedDetector) -> TrainedDetector:
    """Change the detection of a trained detector as the options say."""
    detector = detector if args.second_look else detector.without_second_look()
    return detector.with_inference(flips="x") if args.mirrored else detector


def measured(detector: TrainedDetector, frames: FrameSet) -> dict[str, Any]:
    """Score a detector on frames by range, and on simulated drives also with the official metrics."""
    found, visited = detections(detector, frames)
    drives = None
    if isinstance(frames, NuScenesFrames):
        scenes = [frames.nuscenes.scene_of(token) for token in frames.tokens]
        drives = np.unique(scenes, return_inverse=True)[1].tolist()
    scores = scores_by_range(found, visited, repeats=_REPEATS, groups=drives)
    record: dict[str, Any] = {"keyframes": len(visited), **scores, "overlapping": overlapping_share(found)}
    if isinstance(frames, NuScenesFrames):
        results = {
            token: result_entries(boxes, token, frames.nuscenes.sensor_to_global(token), detector.classes)
            for token, boxes in zip(frames.tokens, found, strict=True)
        }
        boxes = read_results({"meta": LIDAR_META, "results": results}, frames.tokens).boxes
        evaluation = evaluate(boxes, split_truth(frames.nuscenes, frames.tokens))
        for name, key in (("official mAP", "mean_ap"), ("official NDS", "nd_score")):
            record[name] = {
                "score": round(evaluation.summary[key], 4),
                "interval": interval_of(evaluation, key, _REPEATS, drives),
            }
    return record


def overlapping_share(found: Sequence[Detections]) -> float:
    """Share of the shown boxes that overlap a shown box of another class, with an IoU above 0.1 on the ground.

    >>> boxes, both = np.zeros((3, 9)) + [0, 0, 0, 4, 2, 1, 0, 0, 0], np.ones(3, bool)
    >>> boxes[2, 0] = 9.0
    >>> overlapping_share([Detections(boxes, np.ones(3), np.array([0, 1, 1]), both, np.zeros(0))])
    0.6667
    """
    shown, overlapping = 0, 0
    for d in found:
        kept = np.asarray(d.valid) & (np.asarray(d.scores) >= SHOWN_SCORE)
        pair = kept[:, None] & kept & (np.asarray(d.labels)[:, None] != np.asarray(d.labels))
        iou = np.asarray(_overlaps(jnp.asarray(d.boxes, jnp.float32)))
        shown += int(kept.sum())
        overlapping += int((pair & (iou > _OVERLAP)).any(axis=1).sum())
    return round(overlapping / max(shown, 1), 4)


def fine_tuning(args: Args) -> Iterator[dict[str, Any]]:
    """Score unseen keyframes of scene-0523 after training on the others, with and without the checkpoint.

    Both trainings use the checkpoint's network and augmentation, which may differ from the preset's of today. The
    record is yielded after each.
    """
    street = open_frames(real_data(args.data, "nuscenes_scene0523"), split="scene0523", reading=cut_reading(1))
    test, train = (SelectedFrames(street, tuple(indices)) for indices in (TEST, TRAIN))
    record: dict[str, Any] = {"steps": args.fine_tuning_steps, "keyframes": len(train)}
    trained_before = load_trained(args.checkpoint).config
    look = trained_before.refinement and dataclasses.replace(trained_before.refinement, freeze_detector=False)
    shared = {"model": trained_before.model, "augment": trained_before.augment, "refinement": look}
    scratch = change(**shared, copy_paste=None, class_balanced=False)(COMPACT)
    fine_tuned = change(optimizer__peak_learning_rate=1e-3)(scratch)
    # The hash distinguishes weights of the same name.
    runs = args.work / read_description(find_checkpoint(args.checkpoint))["hash"][:12]
    for name, config, weights in (
        ("from the checkpoint", fine_tuned, args.checkpoint),
        ("from scratch", scratch, None),
    ):
        options = {"steps": args.fine_tuning_steps, "seed": 0, "weights": weights}
        detector = trained(runs / name.replace(" ", "_"), config, train, **options)
        record[name] = measured(applied(args, detector), test)
        yield record


def main(args: Args) -> None:
    """Measure the selected parts and save after each."""
    if unknown := {*args.only} - {"simulated", "fine_tuning", *REAL}:
        raise ValueError(f"--only: got {min(unknown)!r}, expected simulated, fine_tuning, or one of {REAL}")
    detector = applied(args, load_trained(args.checkpoint))
    out = args.out or Path("outputs/transfer.json")
    described = read_description(find_checkpoint(args.checkpoint))
    of = {"name": str(args.checkpoint), "step": described["step"], "hash": described["hash"]}
    of |= {"second_look": args.second_look, "mirrored": args.mirrored}
    record = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
    if record.get("checkpoint") != of:
        record = {"checkpoint": of}
    for name, frames in parts(args, detector):
        record[name] = measured(detector, frames)
        if name == "simulated":
            record["drives"] = {n: getattr(args, n) for n in ("scenes", "keyframes", "seed")}
        save(record, out, f"{name}: mAP {record[name]['all']['mAP']} on {len(frames)} keyframes")
    if not args.only or "fine_tuning" in args.only:
        for runs in fine_tuning(args):
            record["fine_tuning"] = runs
            scores = {name: run["all"]["mAP"] for name, run in runs.items() if isinstance(run, dict)}
            save(record, out, f"fine-tuning: {json.dumps(scores)}")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
