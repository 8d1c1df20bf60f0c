"""The training of ``fcos-lidar demo --train``: the quickstart preset from scratch, beside its shipped weights."""

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

_NUM_DRAWN = 3  # frames in the report and in the folder unseen
_NUM_VALIDATED = 10  # test frames of the evaluations during training
_NUM_EVALUATIONS = 6

_TITLES = {"shipped": "shipped weights", "after": "trained here", "before": "untrained"}
_Pictures = list[tuple[str, Path]]  # captions and files


def run(out: Path, steps: int, test_frames: int, seed: int) -> None:
    """Detect with the shipped weights, train, detect again, and write the report.

    Writes metrics.json, pictures, report.html, unseen clouds with their boxes, and the run with its checkpoints.
    Ctrl-C ends the training early and evaluates the result.

    Args:
        out: folder for the results.
        steps: training steps; 0 for no training.
        test_frames: number of unseen frames to evaluate on.
        seed: of the weights and the training frames.
    """
    began = time.monotonic()
    shipped = load_trained("quickstart")
    tests = unseen_frames(shipped.sensor, test_frames)
    frames = [tests.frame(i) for i in range(len(tests))]
    detections: dict[str, list[Detections]] = {}
    metrics: dict[str, Any] = {}

    def assess(model: str, detector: TrainedDetector) -> str:
        """Evaluate on the test frames; returns the score as a line of text."""
        detections[model] = [prediction.detections for prediction in predict(detector, tests)]
        summary = metrics[model] = evaluate_frames(detections[model], frames, metric_of(NUSCENES_CLASSES)).summary
        minutes = (time.monotonic() - began) / 60
        return f"mAP {summary['mean_ap']:.3f} on {test_frames} unseen frames, after {minutes:.1f} minutes"

    line = assess("shipped", shipped)
    _save_frames(out / "unseen", frames, detections)
    limit_m = shipped.sensor.limit_xy_m
    pictures = _draw_frames(out, "shipped", frames, detections["shipped"], limit_m)
    print(f"shipped weights: {line}; see {pictures[0][1]}", flush=True)
    run_folder = out / "run"
    if steps:
        _train(run_folder, steps, test_frames, seed)
        trained = load_trained(run_folder)
        assess("before", TrainedDetector(trained.model, trained.model.init(jax.random.key(seed))))
        line = assess("after", trained)
        metrics["training"] = _training_record(run_folder)
        _save_frames(out / "unseen", frames, detections)
        pictures += _draw_frames(out, "after", frames, detections["after"], limit_m)
    points, path = frames[0].points, out / "range_image.png"
    image = project_points(points, np.ones(len(points), bool), shipped.sensor, num_rounds=1)
    draw_range_image(image, path, title="unseen frame 0 as the network sees it")
    pictures.append(("The range image of unseen frame 0.", path))
    if steps:
        pictures += [
            ("The parts of the loss during the training.", run_folder / "loss.png"),
            ("Scores during the training, on some of the unseen frames.", run_folder / "scores.png"),
        ]
    metrics["minutes"] = round((time.monotonic() - began) / 60, 2)
    atomic_write(out / "metrics.json", lambda p: p.write_text(json.dumps(_without_nan(metrics), indent=1)))
    _report(out, test_frames, metrics, pictures)
    if steps:
        print(f"trained here: {line}; untrained {metrics['before']['mean_ap']:.3f}")
    print(
        f"look at {out / 'report.html'}, or detect in a cloud yourself:\n"
        f"  fcos-lidar detect {out / 'unseen' / 'frame_000.npy'} "
        f"--checkpoint {run_folder if steps else 'quickstart'} "
        f"--out boxes.json --pictures {out / 'detected'}"
    )


def _train(folder: Path, steps: int, test_frames: int, seed: int) -> None:
    config, frames = fresh_streets(QUICKSTART, steps=steps, seed=seed)
    every = max(-(-steps // _NUM_EVALUATIONS), 1)
    print(f"training from random weights on {len(frames)} simulated frames", file=sys.stderr)
    try:
        train(
            config,
            frames,
            folder,
            steps=steps,
            seed=seed,
            tests=unseen_frames(frames.sensor, min(_NUM_VALIDATED, test_frames)),
            resume=(folder / RUN_SPEC).exists(),
            devices=jax.devices()[:1],
            schedule=Schedule(every, every),
            threads=1,
        )
    except KeyboardInterrupt:
        if find_checkpoint(folder) == folder:  # no checkpoint yet
            raise
        print("evaluating the last checkpoint", file=sys.stderr)


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
    """Replace NaN by None, since JSON has no NaN."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    return None if isinstance(value, float) and np.isnan(value) else value


def _draw_frames(
    out: Path, model: str, frames: list[Frame], detections: list[Detections], limit_m: float
) -> _Pictures:
    pictures = []
    for i, (frame, boxes) in enumerate(zip(frames[:_NUM_DRAWN], detections, strict=False)):
        path, title = out / f"{model}_{i}.png", f"unseen frame {i}, {_TITLES[model]}"
        draw_frame(path, frame, boxes, title, limit_m=limit_m, classes=NUSCENES_CLASSES)
        pictures.append((f"Unseen frame {i} from above, {_TITLES[model]}.", path))
    return pictures


def _save_frames(folder: Path, frames: list[Frame], detections: dict[str, list[Detections]]) -> None:
    """Write a few unseen clouds, and JSON files with their truth and detections."""
    for i, frame in enumerate(frames[:_NUM_DRAWN]):
        boxes = zip(frame.labels, frame.boxes.tolist(), strict=True)
        record = {
            "truth": [{"label": NUSCENES_CLASSES[label], "box": box} for label, box in boxes],
            **{m: as_records(d[i], NUSCENES_CLASSES, min_score=SHOWN_SCORE) for m, d in detections.items()},
        }
        text = json.dumps(record, indent=1)
        atomic_write(folder / f"frame_{i:03d}.npy", lambda path, points=frame.points: np.save(path, points))
        atomic_write(folder / f"frame_{i:03d}.json", lambda path, text=text: path.write_text(text))


def _report(out: Path, test_frames: int, metrics: dict[str, Any], pictures: _Pictures) -> None:
    models = [model for model in _TITLES if model in metrics]
    rows = [
        (name.replace("_", " "), *(metrics[model]["mean_dist_aps"][name] for model in models))
        for name in metrics["shipped"]["mean_dist_aps"]
    ]
    summary = {f"mAP, {_TITLES[model]}": metrics[model]["mean_ap"] for model in models}
    summary["unseen frames"] = test_frames
    lead = "A small detector on unseen simulated LiDAR frames: with the shipped weights"
    if training := metrics.get("training"):
        summary |= {"training steps": training["steps"], "frames seen": training["frames_seen"]}
        lead += ", and after a few minutes of training from scratch"
    distances = ", ".join(f"{d:g}" for d in DISTANCES_M)
    caption = f"Average precision per class, mean over the matching distances {distances} m"
    write_report(
        out / "report.html",
        title="FCOS-LiDAR: first contact",
        lead=f"{lead}.",
        summary={**summary, "total minutes": metrics["minutes"]},
        tables=[(caption, ("class", *(_TITLES[model] for model in models)), rows)],
        pictures=pictures,
    )
