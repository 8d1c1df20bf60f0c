"""``fcos-lidar demo``: train and look, without any data."""

import dataclasses
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.commands.clouds import make_cloud
from fcos_lidar_jax.commands.detect import as_records, confident
from fcos_lidar_jax.config import QUICKSTART, Config
from fcos_lidar_jax.data.batching import make_batch
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.evaluation.matching import FrameResult, average_precision
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.projection import project_points, remove_close
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.training import (
    Checkpoint,
    fit,
    load_checkpoint,
    make_optimizer,
    make_state,
    make_train_step,
    save_checkpoint,
)
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.types import CLASSES, Batch, Detections, TrainState
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.curves import draw_curves
from fcos_lidar_jax.visualization.range_image import draw_range_image
from fcos_lidar_jax.visualization.report import write_report

_UNSEEN = 1_000_000
"""Seeds of the test frames start here; training frames never get that far."""
_THRESHOLDS_M = (0.5, 1.0, 2.0, 4.0)
_SHOWN_SCORE = 0.2
"""Pictures show detections from here on: after a few minutes of training the scores are still low."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Train the quickstart detector on simulated LiDAR frames and look at what it finds on unseen ones.

    Needs no data and no GPU. Writes a checkpoint, metrics.json, pictures, report.html, and the unseen clouds with
    their boxes, which `fcos-lidar detect` reads. Ctrl-C ends the training early and evaluates what there is.
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
    args.out.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    config, sensor = QUICKSTART, load_sensor(QUICKSTART.sensor)
    tests = [without_close(make_frame(_UNSEEN + i, sensor), config, sensor) for i in range(args.test_frames)]
    untrained = build_detector(config, sensor).init(jax.random.key(args.seed))
    state, records = _train(args, config, sensor, untrained)
    variables = {"params": state.params, "batch_stats": state.batch_stats}
    save_checkpoint(args.out / "checkpoint", Checkpoint(config, sensor, variables, int(state.step)))
    # What is evaluated is what a user would load.
    loaded = load_checkpoint(args.out / "checkpoint")
    detect = jax.jit(make_detect(build_detector(config, sensor), config, sensor))

    def results_of(weights: Variables) -> tuple[list[Detections], list[FrameResult]]:
        return _detect_all(detect, weights, tests, config, sensor)

    _, before = results_of(untrained)
    found, after = results_of(loaded.variables)
    metrics = {"before": summarise(before), "after": summarise(after)}
    metrics["training"] = {
        "steps": int(state.step),
        "frames_seen": int(state.step) * config.optimizer.batch_size,
        "minutes": round((time.monotonic() - began) / 60, 2),
        "final_loss": records[-1]["loss/total"],
    }
    write_beside(args.out / "metrics.json", lambda p: p.write_text(json.dumps(_without_nan(metrics), indent=1)))
    pictures = _pictures(args.out, tests, found, records, sensor)
    _save_frames(args.out / "unseen", tests, found)
    _report(args, metrics, pictures)
    after_map, before_map = metrics["after"]["mAP"], metrics["before"]["mAP"]
    print(
        f"mAP on {args.test_frames} unseen frames: {after_map:.3f} (untrained {before_map:.3f}), "
        f"{metrics['training']['minutes']} minutes\n"
        f"look at {args.out / 'report.html'}, or detect by yourself:\n"
        f"  fcos-lidar detect {args.out / 'unseen' / 'frame_000.npy'} --checkpoint {args.out / 'checkpoint'} "
        f"--out boxes.json --pictures {args.out / 'detected'}"
    )


def without_close(frame: Frame, config: Config, sensor: Sensor) -> Frame:
    """The frame without the points on the vehicle, as the detector is trained."""
    projection = config.projection
    everything = np.ones(len(frame.points), bool)
    kept = remove_close(frame.points, everything, sensor, mode=projection.remove_close, close_m=projection.close_m)
    return dataclasses.replace(frame, points=frame.points[np.asarray(kept)])


def _batches(args: Demo, config: Config, sensor: Sensor) -> Iterator[Batch]:
    """Training batches without end; the frames of a step depend on the seed and the step alone."""
    size = config.optimizer.batch_size
    first = args.seed * args.steps * size % _UNSEEN
    for step in range(args.steps):
        seeds = [(first + step * size + i) % _UNSEEN for i in range(size)]
        frames = [without_close(make_frame(seed, sensor), config, sensor) for seed in seeds]
        yield make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes)


def _train(args: Demo, config: Config, sensor: Sensor, variables: Variables) -> tuple[TrainState, list[Record]]:
    optimizer = make_optimizer(config.optimizer, args.steps)
    detector = build_detector(config, sensor)
    step = jax.jit(make_train_step(detector, config, sensor, optimizer))
    latest: list[TrainState] = []
    records: list[Record] = []

    def keep(_: int, state: TrainState, record: Record) -> None:
        latest[:] = [state]
        records.append(record)

    print(f"training on {args.steps * config.optimizer.batch_size} simulated frames", file=sys.stderr)
    start = make_state(variables, optimizer, jax.random.key(args.seed))
    try:
        fit(step, start, _batches(args, config, sensor), num_steps=args.steps, report=keep)
    except KeyboardInterrupt:
        if not latest:
            raise
        print(f"stopped after step {int(latest[0].step)}, evaluating", file=sys.stderr)
    return latest[0], records


def _detect_all(
    detect: Any, variables: Variables, frames: list[Frame], config: Config, sensor: Sensor
) -> tuple[list[Detections], list[FrameResult]]:
    found, results = [], []
    for frame in frames:
        cloud = make_cloud(frame.points, sensor, size=config.max_points, remove="none")
        d = jax.tree.map(np.asarray, detect(variables, cloud.points, cloud.valid))
        found.append(d)
        results.append(
            FrameResult(d.boxes[d.valid], d.labels[d.valid], d.scores[d.valid], frame.boxes, frame.labels)
        )
    return found, results


def summarise(frames: list[FrameResult]) -> dict[str, Any]:
    """Average precision by class and distance, and their mean over the classes that occur.

    Args:
        frames: detections and truth.
    """
    by_class = {
        name: {f"{t:g}": average_precision(frames, label, t) for t in _THRESHOLDS_M}
        for label, name in enumerate(CLASSES)
    }
    present = [np.mean(list(aps.values())) for aps in by_class.values() if not np.isnan(list(aps.values())).any()]
    return {"mAP": float(np.mean(present)) if present else float("nan"), "AP": by_class}


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and np.isnan(value) else value


def _pictures(
    out: Path, frames: list[Frame], found: list[Detections], records: list[Record], sensor: Sensor
) -> list[tuple[str, Path]]:
    pictures = []
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
    parts = ("total", "classification", "l1", "iou", "iou_prediction")
    series = {p: [(i + 1.0, float(r[f"loss/{p}"])) for i, r in enumerate(records)] for p in parts}  # type: ignore[arg-type]
    path = out / "loss.png"
    draw_curves(path, series, x_label="step", y_label="loss", title="training", log_y=True)
    pictures.append(("The parts of the loss through the training.", path))
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
                ("class", *(f"{t:g} m" for t in _THRESHOLDS_M), "untrained, mean"),
                rows,
            )
        ],
        pictures=pictures,
    )
