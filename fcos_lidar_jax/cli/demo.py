"""``fcos-lidar demo``: a trained detector at work, and one in training, without any data."""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import DISTANCES_M, metric_of
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.inference import TrainedDetector, load_detector
from fcos_lidar_jax.inference.records import as_records, confident
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation.frame_set import fresh_streets, unseen_frames
from fcos_lidar_jax.trainer import Schedule, predict, train
from fcos_lidar_jax.trainer.run import RUN_SPEC
from fcos_lidar_jax.training.checkpoints import find_checkpoint
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.types import Detections
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import write_report

_SHOWN_SCORE = 0.2
"""Pictures show detections from here on: after a few minutes of training the scores are still low."""
_SHOWN_FRAMES = 3
_FRAMES_ALONG = 10
"""Test frames of the evaluations during training."""
_EVALUATIONS = 6
"""During training."""

Found = dict[str, list[Detections]]
"""Model -> what it finds in the test frames."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Look at a trained detector on simulated LiDAR frames that it has never seen, then train one from scratch.

    Needs no data and no GPU. The shipped weights come first; `--steps 0` stops there. Writes metrics.json,
    pictures, report.html, the unseen clouds with their boxes, which `fcos-lidar detect` reads, and the run with
    its checkpoints. Ctrl-C ends the training early and evaluates what there is; the same command goes on where it
    was stopped.
    """

    out: Path = Path("demo_output")
    """Folder for the results."""
    steps: int = 2000
    """Training steps; 0 for none."""
    test_frames: int = 40
    """Unseen frames to evaluate on."""
    seed: int = 0
    """Of the weights and the training frames."""


def run(args: Demo) -> None:
    """Detect with the shipped weights, train, detect again, and report."""
    for name, least in (("steps", 0), ("test_frames", 1)):
        value = getattr(args, name)
        if value < least:
            raise ValueError(f"--{name.replace('_', '-')}: got {value}, expected at least {least}")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out: {args.out}: found a file, expected a folder")
    began = time.monotonic()
    shipped = load_detector("quickstart")
    tests = unseen_frames(shipped.sensor, args.test_frames)
    frames = [tests.frame(i) for i in range(len(tests))]
    found: Found = {"shipped": _detections(shipped, tests)}
    metrics: dict[str, Any] = {"shipped": _scores(found["shipped"], frames)}
    _save_frames(args.out / "unseen", frames, found)
    pictures = _draw_frames(args.out, frames, found, shipped.sensor)
    print(f"shipped weights: {_told(metrics['shipped'], args, began)}; see {pictures[0][1]}", flush=True)
    run_folder = args.out / "run"
    if args.steps:
        _train(args, run_folder)
        # What is evaluated is what a user would load.
        trained = load_detector(run_folder)
        untrained = TrainedDetector(trained.model, trained.model.init(jax.random.key(args.seed)))
        for model, detector in (("before", untrained), ("after", trained)):
            found[model] = _detections(detector, tests)
            metrics[model] = _scores(found[model], frames)
        metrics["training"] = _training_record(run_folder)
        _save_frames(args.out / "unseen", frames, found)
        pictures = [
            *_draw_frames(args.out, frames, found, shipped.sensor),
            ("The parts of the loss through the training.", run_folder / "loss.png"),
            ("Scores through the training, on some of the unseen frames.", run_folder / "scores.png"),
        ]
    metrics["minutes"] = round((time.monotonic() - began) / 60, 2)
    atomic_write(args.out / "metrics.json", lambda p: p.write_text(json.dumps(_without_nan(metrics), indent=1)))
    _report(args, metrics, pictures)
    if args.steps:
        before = metrics["before"]["mean_ap"]
        print(f"trained here: {_told(metrics['after'], args, began)}; untrained {before:.3f}")
    checkpoint_name = run_folder if args.steps else "quickstart"
    print(
        f"look at {args.out / 'report.html'}, or detect by yourself:\n"
        f"  fcos-lidar detect {args.out / 'unseen' / 'frame_000.npy'} --checkpoint {checkpoint_name} "
        f"--out boxes.json --pictures {args.out / 'detected'}"
    )


def _told(summary: dict[str, Any], args: Demo, began: float) -> str:
    minutes = (time.monotonic() - began) / 60
    return f"mAP {summary['mean_ap']:.3f} on {args.test_frames} unseen frames, after {minutes:.1f} minutes"


def _detections(detector: TrainedDetector, frames: FrameSet) -> list[Detections]:
    return [prediction.detections for prediction in predict(detector, frames)]


def _scores(found: list[Detections], frames: list[Frame]) -> dict[str, Any]:
    return evaluate_frames(found, frames, metric_of(NUSCENES_CLASSES)).summary


def _train(args: Demo, folder: Path) -> None:
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
    losses = [(record["step"], record["loss/total"]) for record in records if "loss/total" in record]
    return {
        "steps": losses[-1][0],
        "frames_seen": losses[-1][0] * QUICKSTART.optimizer.batch_size,
        "final_loss": losses[-1][1],
        "curve": [[record["step"], record["test/mAP"]] for record in records if "test/mAP" in record],
    }


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and np.isnan(value) else value


_TITLES = {"shipped": "shipped weights", "after": "trained here", "before": "untrained"}


def _draw_frames(out: Path, frames: list[Frame], found: Found, sensor: Sensor) -> list[tuple[str, Path]]:
    pictures = []
    for model in ("shipped", "after"):
        for i, (frame, d) in enumerate(list(zip(frames, found.get(model, []), strict=False))[:_SHOWN_FRAMES]):
            path = out / f"{model}_{i}.png"
            draw_bev(
                frame.points,
                path,
                limit_m=sensor.limit_xy_m,
                classes=NUSCENES_CLASSES,
                detections=confident(d, _SHOWN_SCORE),
                truth=(frame.boxes, frame.labels),
                title=f"unseen frame {i}, {_TITLES[model]}: score {_SHOWN_SCORE} and more, truth dashed",
            )
            pictures.append((f"Unseen frame {i} from above, {_TITLES[model]}.", path))
    path = out / "range_image.png"
    image = project_points(frames[0].points, np.ones(len(frames[0].points), bool), sensor, num_rounds=1)
    draw_range_image(image, path, title="unseen frame 0 as the network sees it")
    return [*pictures, ("The range image of unseen frame 0.", path)]


def _save_frames(folder: Path, frames: list[Frame], found: Found) -> None:
    """A few unseen clouds with truth and detections, as files that other commands read."""
    for i, frame in enumerate(frames[:_SHOWN_FRAMES]):
        truth = [
            {"label": NUSCENES_CLASSES[k], "box": [float(v) for v in b]}
            for k, b in zip(frame.labels, frame.boxes, strict=True)
        ]
        shown = {m: as_records(d[i], NUSCENES_CLASSES, min_score=_SHOWN_SCORE) for m, d in found.items()}
        record = {"truth": truth, **shown}

        def save(path: Path, points: np.ndarray = frame.points) -> None:
            with path.open("wb") as stream:
                np.save(stream, points)

        atomic_write(folder / f"frame_{i:03d}.npy", save)
        atomic_write(
            folder / f"frame_{i:03d}.json",
            lambda path, record=record: path.write_text(json.dumps(record, indent=1)),
        )


def _report(args: Demo, metrics: dict[str, Any], pictures: list[tuple[str, Path]]) -> None:
    models = [model for model in _TITLES if model in metrics]
    rows = [
        (name.replace("_", " "), *(metrics[model]["mean_dist_aps"][name] for model in models))
        for name in metrics["shipped"]["mean_dist_aps"]
    ]
    distances = ", ".join(f"{d:g}" for d in DISTANCES_M)
    summary = {f"mAP, {_TITLES[model]}": metrics[model]["mean_ap"] for model in models}
    summary["unseen frames"] = args.test_frames
    if args.steps:
        summary |= {
            "training steps": metrics["training"]["steps"],
            "frames seen": metrics["training"]["frames_seen"],
        }
    write_report(
        args.out / "report.html",
        title="FCOS-LiDAR: first contact",
        lead="A small detector on simulated LiDAR frames that it has never seen: with the weights that are shipped"
        + (", and with those of a few minutes of training from scratch." if args.steps else "."),
        summary={**summary, "minutes, all in all": metrics["minutes"]},
        tables=[
            (
                f"Average precision by class, mean over the matching distances {distances} m",
                ("class", *(_TITLES[model] for model in models)),
                rows,
            )
        ],
        pictures=pictures,
    )
