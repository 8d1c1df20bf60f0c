"""``fcos-lidar demo``: train and look, without any data."""

import dataclasses
import json
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.commands.detect import as_records, confident
from fcos_lidar_jax.commands.runs import Plan, Rhythm, Run
from fcos_lidar_jax.config import QUICKSTART
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.data.pipeline import make_batches
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import DISTANCES_M
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.records import read_records
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots
from fcos_lidar_jax.types import CLASSES, Detections
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import write_report

_UNSEEN = 1_000_000
"""Seeds of the test frames start here; training frames never get that far."""
_SHOWN_SCORE = 0.2
"""Pictures show detections from here on: after a few minutes of training the scores are still low."""
_FRAMES_ALONG = 10
"""Test frames of the evaluations during training."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Train the quickstart detector on simulated LiDAR frames and look at what it finds on unseen ones.

    Needs no data and no GPU. Writes a run with checkpoints, metrics.json, pictures, report.html, and the unseen
    clouds with their boxes, which `fcos-lidar detect` reads. Ctrl-C ends the training early and evaluates what
    there is; the same command goes on where it was stopped.
    """

    out: Path = Path("demo_output")
    """Folder for the results."""
    steps: int = 600
    """Training steps of four frames each."""
    test_frames: int = 40
    """Unseen frames to evaluate on."""
    seed: int = 0
    """Of the weights and the training frames."""


def run(args: Demo) -> None:
    """Do it."""
    for name in ("steps", "test_frames"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')}: got {getattr(args, name)}, expected at least 1")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out: {args.out}: found a file, expected a folder")
    began = time.monotonic()
    training = _make_run(args)
    tests = SimulatedFrames(training.plan.sensor, args.test_frames, _UNSEEN)
    untrained = training.detector.init(jax.random.key(args.seed))
    _train(args, training)
    # What is evaluated is what a user would load.
    checkpoint = load_checkpoint(Snapshots(training.folder / CHECKPOINTS).paths()[-1])
    frames = [tests.frame(i) for i in range(len(tests))]
    print(f"evaluating on {len(frames)} unseen frames", file=sys.stderr)
    found = [training.detections(checkpoint.variables, frame) for frame in frames]
    before = [training.detections(untrained, frame) for frame in frames]
    records = read_records(training.folder)
    losses = [record["loss/total"] for record in records if "loss/total" in record]
    metrics = {
        "before": summarise(before, frames),
        "after": summarise(found, frames),
        "training": {
            "steps": checkpoint.step,
            "frames_seen": checkpoint.step * checkpoint.config.optimizer.batch_size,
            "minutes": round((time.monotonic() - began) / 60, 2),
            "final_loss": losses[-1],
            "curve": [[r["step"], r["test/mAP"]] for r in records if "test/mAP" in r],
        },
    }
    write_beside(args.out / "metrics.json", lambda p: p.write_text(json.dumps(_without_nan(metrics), indent=1)))
    pictures = _pictures(args.out, frames, found, training)
    _save_frames(args.out / "unseen", frames, found)
    _report(args, metrics, pictures)
    after_map, before_map = metrics["after"]["mAP"], metrics["before"]["mAP"]
    print(
        f"mAP on {args.test_frames} unseen frames: {after_map:.3f} (untrained {before_map:.3f}), "
        f"{metrics['training']['minutes']} minutes\n"
        f"look at {args.out / 'report.html'}, or detect by yourself:\n"
        f"  fcos-lidar detect {args.out / 'unseen' / 'frame_000.npy'} --checkpoint {training.folder} "
        f"--out boxes.json --pictures {args.out / 'detected'}"
    )


def _make_run(args: Demo) -> Run:
    # Every frame is a new street with all classes: nothing to resample, nothing to paste.
    config = dataclasses.replace(QUICKSTART, copy_paste=None, class_balanced=False)
    sensor = load_sensor(config.sensor)
    plan = Plan(config, sensor, args.steps, args.seed, {"simulated": args.steps * config.optimizer.batch_size})
    along = SimulatedFrames(sensor, min(_FRAMES_ALONG, args.test_frames), _UNSEEN)
    every = -(-args.steps // 6)
    return Run(args.out / "run", plan, Rhythm(save_every=every, evaluate_every=every), along)


def _train(args: Demo, training: Run) -> None:
    plan = training.plan
    number = min(plan.num_steps * plan.config.optimizer.batch_size, _UNSEEN // 2)
    frames: FrameSet = SimulatedFrames(plan.sensor, number, args.seed * number % (_UNSEEN - number))

    def feed(first_step: int) -> AbstractContextManager[Any]:
        return make_batches(
            frames, plan.config, seed=args.seed, num_steps=plan.num_steps, first_step=first_step, threads=1
        )

    print(f"training on {number} simulated frames", file=sys.stderr)
    try:
        training.train(feed, resume=(training.folder / "run.json").exists())
    except KeyboardInterrupt:
        if not training.snapshots.paths():
            raise
        print("evaluating what there is", file=sys.stderr)


def summarise(found: list[Detections], frames: list[Frame]) -> dict[str, Any]:
    """Average precision by class and distance, and their mean over the classes that occur.

    Args:
        found: detections in every frame.
        frames: the truth.
    """
    evaluation = evaluate_frames(found, frames)
    by_class: dict[str, dict[str, float]] = {}
    for name, ranking in zip(CLASSES, evaluation.rankings, strict=True):
        occurs = len(ranking.truth_sample) > 0
        aps = evaluation.summary["label_aps"][name]
        by_class[name] = {f"{d:g}": aps[str(d)] if occurs else float("nan") for d in DISTANCES_M}
    means = np.array([np.mean(list(aps.values())) for aps in by_class.values()])
    present = means[~np.isnan(means)]
    return {"mAP": float(present.mean()) if len(present) else float("nan"), "AP": by_class}


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and np.isnan(value) else value


def _pictures(out: Path, frames: list[Frame], found: list[Detections], training: Run) -> list[tuple[str, Path]]:
    pictures, sensor = [], training.plan.sensor
    for i, (frame, d) in enumerate(list(zip(frames, found, strict=True))[:3]):
        path = out / f"bev_{i}.png"
        draw_bev(
            frame.points,
            path,
            limit_m=sensor.limit_xy_m,
            detections=confident(d, _SHOWN_SCORE),
            truth=(frame.boxes, frame.labels),
            title=f"unseen frame {i}: detections of score {_SHOWN_SCORE} and more, truth dashed",
        )
        pictures.append((f"Unseen frame {i} from above.", path))
    path = out / "range_image.png"
    image = project_points(frames[0].points, np.ones(len(frames[0].points), bool), sensor, num_rounds=1)
    draw_range_image(image, path, title="unseen frame 0 as the network sees it")
    pictures.append(("The range image of unseen frame 0.", path))
    pictures.append(("The parts of the loss through the training.", training.folder / "loss.png"))
    few = f"{training.tests and len(training.tests)} of the unseen frames"
    pictures.append((f"Scores through the training, on {few}.", training.folder / "scores.png"))
    return pictures


def _save_frames(folder: Path, frames: list[Frame], found: list[Detections]) -> None:
    """A few unseen clouds with truth and detections, as files that other commands read."""
    for i, (frame, d) in enumerate(list(zip(frames, found, strict=True))[:3]):
        truth = [
            {"label": CLASSES[k], "box": [float(v) for v in b]}
            for k, b in zip(frame.labels, frame.boxes, strict=True)
        ]
        record = {"truth": truth, "detections": as_records(d, min_score=_SHOWN_SCORE)}

        def save(path: Path, points: np.ndarray = frame.points) -> None:
            with path.open("wb") as stream:
                np.save(stream, points)

        write_beside(folder / f"frame_{i:03d}.npy", save)
        write_beside(
            folder / f"frame_{i:03d}.json",
            lambda path, record=record: path.write_text(json.dumps(record, indent=1)),
        )


def _report(args: Demo, metrics: dict[str, Any], pictures: list[tuple[str, Path]]) -> None:
    training = metrics["training"]
    rows = [
        (name.replace("_", " "), *aps.values(), np.mean(list(metrics["before"]["AP"][name].values())).item())
        for name, aps in metrics["after"]["AP"].items()
    ]
    write_report(
        args.out / "report.html",
        title="FCOS-LiDAR: first contact",
        lead="A small detector, trained from random weights on simulated LiDAR frames, and what it finds on "
        "frames that it has never seen.",
        summary={
            "mAP, trained": metrics["after"]["mAP"],
            "mAP, untrained": metrics["before"]["mAP"],
            "unseen frames": args.test_frames,
            "training steps": training["steps"],
            "frames seen": training["frames_seen"],
            "minutes, all in all": training["minutes"],
        },
        tables=[
            (
                "Average precision by class and matching distance",
                ("class", *(f"{t:g} m" for t in DISTANCES_M), "untrained, mean"),
                rows,
            )
        ],
        pictures=pictures,
    )
