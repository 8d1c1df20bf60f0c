"""Pictures of a run: curves of its metrics, and detections in a few test frames."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.evaluation.records import confident
from fcos_lidar_jax.inference.prediction import Prediction
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.types import Detections

SHOWN_SCORE = 0.2  # minimum score of detections in pictures; scores are low early in training


def draw_metrics(folder: Path) -> None:
    """Draw the losses of a run as ``loss.png`` and, if it was evaluated, its mAP as ``scores.png``."""
    from fcos_lidar_jax.visualization.curves import draw_curves

    lines = read_metrics(folder)
    parts = dict.fromkeys(name for line in lines for name in line if name.startswith("loss/"))
    losses = {p.removeprefix("loss/"): [(line["step"], line[p]) for line in lines if p in line] for p in parts}
    draw_curves(folder / "loss.png", losses, x_label="step", y_label="loss", title="training", log_y=True)
    scores = {"mAP": [(line["step"], line["test/mAP"]) for line in lines if "test/mAP" in line]}
    if scores["mAP"]:
        draw_curves(folder / "scores.png", scores, x_label="step", y_label="", title="test frames")


def draw_predictions(folder: Path, predictions: Iterable[Prediction], frames: FrameSet, step: int) -> None:
    """Draw one picture per test frame: its bird's-eye view with detections and truth."""
    folder.mkdir(exist_ok=True)
    for prediction in predictions:
        frame = prediction.frame or frames.frame(prediction.index)
        path = folder / f"step_{step:06d}_frame_{prediction.index}.png"
        title, limit_m = f"step {step}, test frame {prediction.index}", frames.sensor.limit_xy_m
        draw_frame(path, frame, prediction.detections, title, limit_m=limit_m, classes=frames.classes)


def draw_frame(
    path: Path, frame: Frame, detections: Detections, title: str, *, limit_m: float, classes: Sequence[str]
) -> None:
    """Draw the bird's-eye view of a frame with its truth and the detections that reach :data:`SHOWN_SCORE`."""
    from fcos_lidar_jax.visualization.bev import draw_bev

    found, truth = confident(detections, SHOWN_SCORE), (frame.boxes, frame.labels)
    title = f"{title}: scores of at least {SHOWN_SCORE}, truth dashed"
    draw_bev(frame.points, path, limit_m=limit_m, classes=classes, detections=found, truth=truth, title=title)
