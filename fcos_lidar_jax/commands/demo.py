"""``fcos-lidar demo``: a trained detector at work, and one in training, without any data."""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fcos_lidar_jax.commands.detect import as_records, confident
from fcos_lidar_jax.commands.runs import Rhythm
from fcos_lidar_jax.commands.simulated import SimulatedTraining, on_fresh_streets, unseen_frames
from fcos_lidar_jax.config import QUICKSTART
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.evaluation.frames import evaluate_frames
from fcos_lidar_jax.evaluation.metrics import DISTANCES_M
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.training import load_checkpoint
from fcos_lidar_jax.training.records import read_records
from fcos_lidar_jax.training.shipped import shipped_checkpoints
from fcos_lidar_jax.training.snapshots import CHECKPOINTS, Snapshots
from fcos_lidar_jax.types import CLASSES, Detections
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
    """Do it."""
    for name, least in (("steps", 0), ("test_frames", 1)):
        value = getattr(args, name)
        if value < least:
            raise ValueError(f"--{name.replace('_', '-')}: got {value}, expected at least {least}")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out: {args.out}: found a file, expected a folder")
    began = time.monotonic()
    config = on_fresh_streets(QUICKSTART)
    sensor = load_sensor(config.sensor)
    tests = unseen_frames(sensor, args.test_frames)
    frames = [tests.frame(i) for i in range(len(tests))]
    training = _make_training(args, config, sensor)
    variables: dict[str, Variables] = {"shipped": load_checkpoint(shipped_checkpoints()["quickstart"]).variables}

    def look(model: str) -> list[Detections]:
        return [training.run.detections(variables[model], frame) for frame in frames]

    found: Found = {"shipped": look("shipped")}
    metrics: dict[str, Any] = {"shipped": summarise(found["shipped"], frames)}
    _save_frames(args.out / "unseen", frames, found)
    pictures = _draw_frames(args.out, frames, found, sensor)
    print(f"shipped weights: {_told(metrics['shipped'], args, began)}; see {pictures[0][1]}", flush=True)
    if args.steps:
        variables["before"] = training.run.detector.init(jax.random.key(args.seed))
        _train(training)
        # What is evaluated is what a user would load.
        checkpoint = load_checkpoint(Snapshots(training.run.folder / CHECKPOINTS).paths()[-1])
        variables["after"] = checkpoint.variables
        for model in ("before", "after"):
            found[model] = look(model)
            metrics[model] = summarise(found[model], frames)
        metrics["training"] = _told_by_records(training, checkpoint.step)
        _save_frames(args.out / "unseen", frames, found)
        pictures = _draw_frames(args.out, frames, found, sensor) + _curves(training)
    metrics["minutes"] = round((time.monotonic() - began) / 60, 2)
    write_beside(args.out / "metrics.json", lambda p: p.write_text(json.dumps(_without_nan(metrics), indent=1)))
    _report(args, metrics, pictures)
    if args.steps:
        untrained = metrics["before"]["mAP"]
        print(f"trained here: {_told(metrics['after'], args, began)}; untrained {untrained:.3f}")
    checkpoint_name = training.run.folder if args.steps else "quickstart"
    print(
        f"look at {args.out / 'report.html'}, or detect by yourself:\n"
        f"  fcos-lidar detect {args.out / 'unseen' / 'frame_000.npy'} --checkpoint {checkpoint_name} "
        f"--out boxes.json --pictures {args.out / 'detected'}"
    )


def _told(summary: dict[str, Any], args: Demo, began: float) -> str:
    minutes = (time.monotonic() - began) / 60
    return f"mAP {summary['mAP']:.3f} on {args.test_frames} unseen frames, after {minutes:.1f} minutes"


def _make_training(args: Demo, config: Any, sensor: Sensor) -> SimulatedTraining:
    every = max(-(-args.steps // _EVALUATIONS), 1)
    return SimulatedTraining(
        args.out / "run",
        config,
        steps=max(args.steps, 1),
        seed=args.seed,
        rhythm=Rhythm(save_every=every, evaluate_every=every),
        tests=unseen_frames(sensor, min(_FRAMES_ALONG, args.test_frames)),
    )


def _train(training: SimulatedTraining) -> None:
    print(f"training from random weights on {len(training.frames)} simulated frames", file=sys.stderr)
    try:
        training.train()
    except KeyboardInterrupt:
        if not training.run.snapshots.paths():
            raise
        print("evaluating what there is", file=sys.stderr)


def _told_by_records(training: SimulatedTraining, steps: int) -> dict[str, Any]:
    records = read_records(training.run.folder)
    return {
        "steps": steps,
        "frames_seen": steps * training.run.plan.config.optimizer.batch_size,
        "final_loss": [record["loss/total"] for record in records if "loss/total" in record][-1],
        "curve": [[record["step"], record["test/mAP"]] for record in records if "test/mAP" in record],
    }


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
                detections=confident(d, _SHOWN_SCORE),
                truth=(frame.boxes, frame.labels),
                title=f"unseen frame {i}, {_TITLES[model]}: score {_SHOWN_SCORE} and more, truth dashed",
            )
            pictures.append((f"Unseen frame {i} from above, {_TITLES[model]}.", path))
    path = out / "range_image.png"
    image = project_points(frames[0].points, np.ones(len(frames[0].points), bool), sensor, num_rounds=1)
    draw_range_image(image, path, title="unseen frame 0 as the network sees it")
    return [*pictures, ("The range image of unseen frame 0.", path)]


def _curves(training: SimulatedTraining) -> list[tuple[str, Path]]:
    folder, tests = training.run.folder, training.run.tests
    return [
        ("The parts of the loss through the training.", folder / "loss.png"),
        (f"Scores through the training, on {tests and len(tests)} of the unseen frames.", folder / "scores.png"),
    ]


def _save_frames(folder: Path, frames: list[Frame], found: Found) -> None:
    """A few unseen clouds with truth and detections, as files that other commands read."""
    for i, frame in enumerate(frames[:_SHOWN_FRAMES]):
        truth = [
            {"label": CLASSES[k], "box": [float(v) for v in b]}
            for k, b in zip(frame.labels, frame.boxes, strict=True)
        ]
        record = {"truth": truth, **{m: as_records(d[i], min_score=_SHOWN_SCORE) for m, d in found.items()}}

        def save(path: Path, points: np.ndarray = frame.points) -> None:
            with path.open("wb") as stream:
                np.save(stream, points)

        write_beside(folder / f"frame_{i:03d}.npy", save)
        write_beside(
            folder / f"frame_{i:03d}.json",
            lambda path, record=record: path.write_text(json.dumps(record, indent=1)),
        )


def _report(args: Demo, metrics: dict[str, Any], pictures: list[tuple[str, Path]]) -> None:
    models = [model for model in _TITLES if model in metrics]
    rows = [
        (name.replace("_", " "), *(np.mean(list(metrics[model]["AP"][name].values())).item() for model in models))
        for name in CLASSES
    ]
    distances = ", ".join(f"{d:g}" for d in DISTANCES_M)
    summary = {f"mAP, {_TITLES[model]}": metrics[model]["mAP"] for model in models}
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
