"""The training of ``fcos-lidar demo --train``: the shipped quickstart, and its preset trained from scratch."""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import DISTANCES_M, metric_of
from fcos_lidar_jax.evaluation.records import as_records
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frame_set import fresh_streets, unseen_frames
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.training.pictures import SHOWN_SCORE, draw_frame
from fcos_lidar_jax.training.plan import RUN_SPEC
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import write_report

_SHOWN_FRAMES = 3
_FRAMES_ALONG = 10  # Test frames of the evaluations during training.
_EVALUATIONS = 6  # During training.

_TITLES = {"shipped": "shipped weights", "after": "trained here", "before": "untrained"}


@dataclasses.dataclass(frozen=True)
class TrainingDemo:
    """Where to, and how long."""

    out: Path  # Folder for the results.
    steps: int  # Training steps; 0 for none.
    test_frames: int  # Unseen frames to evaluate on.
    seed: int  # Of the weights and the training frames.


def run(args: TrainingDemo) -> None:
    """Detect with the shipped weights, train, detect again, and report.

    Writes metrics.json, pictures, report.html, the unseen clouds with their boxes, which ``fcos-lidar detect``
    reads, and the run with its checkpoints. Ctrl-C ends the training early and evaluates what there is.
    """
    began = time.monotonic()
    shipped = load_trained("quickstart")
    tests = unseen_frames(shipped.sensor, args.test_frames)
    frames = [tests.frame(i) for i in range(len(tests))]
    found: dict[str, list[Detections]] = {}
    metrics: dict[str, Any] = {}

    def assess(model: str, detector: TrainedDetector) -> str:
        """Detect in the test frames and evaluate; returns the scores as a line of text."""
        found[model] = [prediction.detections for prediction in predict(detector, tests)]
        summary = metrics[model] = evaluate_frames(found[model], frames, metric_of(NUSCENES_CLASSES)).summary
        minutes = (time.monotonic() - began) / 60
        return f"mAP {summary['mean_ap']:.3f} on {args.test_frames} unseen frames, after {minutes:.1f} minutes"

    line = assess("shipped", shipped)
    _save_frames(args.out / "unseen", frames, found)
    limit_m = shipped.sensor.limit_xy_m
    pictures = _draw_frames(args.out, "shipped", frames, found["shipped"], limit_m)
    print(f"shipped weights: {line}; see {pictures[0][1]}", flush=True)
    run_folder = args.out / "run"
    if args.steps:
        _train(args, run_folder)
        trained = load_trained(run_folder)  # what a user would load
        assess("before", TrainedDetector(trained.model, trained.model.init(jax.random.key(args.seed))))
        line = assess("after", trained)
        metrics["training"] = _training_record(run_folder)
        _save_frames(args.out / "unseen", frames, found)
        pictures += _draw_frames(args.out, "after", frames, found["after"], limit_m)
    points, path = frames[0].points, args.out / "range_image.png"
    image = project_points(points, np.ones(len(points), bool), shipped.sensor, num_rounds=1)
    draw_range_image(image, path, title="unseen frame 0 as the network sees it")
    pictures.append(("The range image of unseen frame 0.", path))
    if args.steps:
        pictures += [
            ("The parts of the loss through the training.", run_folder / "loss.png"),
            ("Scores through the training, on some of the unseen frames.", run_folder / "scores.png"),
        ]
    metrics["minutes"] = round((time.monotonic() - began) / 60, 2)
    atomic_write(args.out / "metrics.json", lambda p: p.write_text(json.dumps(_without_nan(metrics), indent=1)))
    _report(args, metrics, pictures)
    if args.steps:
        print(f"trained here: {line}; untrained {metrics['before']['mean_ap']:.3f}")
    print(
        f"look at {args.out / 'report.html'}, or detect by yourself:\n"
        f"  fcos-lidar detect {args.out / 'unseen' / 'frame_000.npy'} "
        f"--checkpoint {run_folder if args.steps else 'quickstart'} "
        f"--out boxes.json --pictures {args.out / 'detected'}"
    )


def _train(args: TrainingDemo, folder: Path) -> None:
    config, frames = fresh_streets(QUICKSTART, steps=args.steps, seed=args.seed)
    every = max(-(-args.steps // _EVALUATIONS), 1)
    print(f"training from random weights on {len(frames)} simulated frames", file=sys.stderr)
    try:
        train(
            config,
            frames,
            folder,
            steps=args.steps,
            seed=args.seed,
            tests=unseen_frames(frames.sensor, min(_FRAMES_ALONG, args.test_frames)),
            resume=(folder / RUN_SPEC).exists(),
            devices=jax.devices()[:1],
            schedule=Schedule(every, every),
            threads=1,
        )
    except KeyboardInterrupt:
        if find_checkpoint(folder) == folder:
            raise
        print("evaluating what there is", file=sys.stderr)


def _training_record(folder: Path) -> dict[str, Any]:
    records = read_metrics(folder)
    steps, loss = [(record["step"], record["loss/total"]) for record in records if "loss/total" in record][-1]
    return {
        "steps": steps,
        "frames_seen": steps * QUICKSTART.optimizer.batch_size,
        "final_loss": loss,
        "curve": [[record["step"], record["test/mAP"]] for record in records if "test/mAP" in record],
    }


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and np.isnan(value) else value


def _draw_frames(
    out: Path, model: str, frames: list[Frame], found: list[Detections], limit_m: float
) -> list[tuple[str, Path]]:
    pictures = []
    for i, (frame, detections) in enumerate(zip(frames[:_SHOWN_FRAMES], found, strict=False)):
        path, title = out / f"{model}_{i}.png", f"unseen frame {i}, {_TITLES[model]}"
        draw_frame(path, frame, detections, title, limit_m=limit_m, classes=NUSCENES_CLASSES)
        pictures.append((f"Unseen frame {i} from above, {_TITLES[model]}.", path))
    return pictures


def _save_frames(folder: Path, frames: list[Frame], found: dict[str, list[Detections]]) -> None:
    """A few unseen clouds with truth and detections, as files that other commands read."""
    for i, frame in enumerate(frames[:_SHOWN_FRAMES]):
        boxes = zip(frame.labels, frame.boxes.tolist(), strict=True)
        record = {
            "truth": [{"label": NUSCENES_CLASSES[label], "box": box} for label, box in boxes],
            **{m: as_records(d[i], NUSCENES_CLASSES, min_score=SHOWN_SCORE) for m, d in found.items()},
        }
        text = json.dumps(record, indent=1)
        atomic_write(folder / f"frame_{i:03d}.npy", lambda path, points=frame.points: np.save(path, points))
        atomic_write(folder / f"frame_{i:03d}.json", lambda path, text=text: path.write_text(text))


def _report(args: TrainingDemo, metrics: dict[str, Any], pictures: list[tuple[str, Path]]) -> None:
    models = [model for model in _TITLES if model in metrics]
    rows = [
        (name.replace("_", " "), *(metrics[model]["mean_dist_aps"][name] for model in models))
        for name in metrics["shipped"]["mean_dist_aps"]
    ]
    distances = ", ".join(f"{d:g}" for d in DISTANCES_M)
    summary = {f"mAP, {_TITLES[model]}": metrics[model]["mean_ap"] for model in models}
    summary["unseen frames"] = args.test_frames
    lead = "A small detector on simulated LiDAR frames that it has never seen: with the weights that are shipped"
    if args.steps:
        training = metrics["training"]
        summary |= {"training steps": training["steps"], "frames seen": training["frames_seen"]}
        lead += ", and with those of a few minutes of training from scratch"
    caption = f"Average precision by class, mean over the matching distances {distances} m"
    write_report(
        args.out / "report.html",
        title="FCOS-LiDAR: first contact",
        lead=f"{lead}.",
        summary={**summary, "minutes, all in all": metrics["minutes"]},
        tables=[(caption, ("class", *(_TITLES[model] for model in models)), rows)],
        pictures=pictures,
    )
