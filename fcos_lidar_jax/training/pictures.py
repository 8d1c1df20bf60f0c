"""Pictures of a run: curves of its metrics, and detections in a few test frames."""

from collections.abc import Iterable
from pathlib import Path

from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, confident
from fcos_lidar_jax.inference.prediction import Prediction
from fcos_lidar_jax.training.metrics_log import read_metrics


def draw_metrics(folder: Path) -> None:
    """Draw the losses of a run as ``loss.png`` and, if it was evaluated, its mAP as ``scores.png``."""
    from fcos_lidar_jax.visualization.figure import draw_curves

    lines = read_metrics(folder)
    parts = dict.fromkeys(name for line in lines for name in line if name.startswith("loss/"))
    losses = {p.removeprefix("loss/"): [(line["step"], line[p]) for line in lines if p in line] for p in parts}
    draw_curves(folder / "loss.png", losses, x_label="step", y_label="loss", title="training", log_y=True)
    scores = {"mAP": [(line["step"], line["test/mAP"]) for line in lines if "test/mAP" in line]}
    if scores["mAP"]:
        draw_curves(folder / "scores.png", scores, x_label="step", y_label="", title="test frames")


def draw_predictions(folder: Path, predictions: Iterable[Prediction], frames: FrameSet, step: int) -> list[Path]:
    """Draw test frames from above, with their truth and the detections that reach a score; returns the files."""
    from fcos_lidar_jax.visualization.bev import draw_bev

    paths = []
    for prediction in predictions:
        frame = prediction.frame or frames.frame(prediction.index)
        paths.append(folder / f"step_{step:06d}_frame_{prediction.index}.png")
        draw_bev(
            frame.points,
            paths[-1],
            limit_m=frames.sensor.limit_xy_m,
            classes=frames.classes,
            detections=confident(prediction.detections, SHOWN_SCORE),
            truth=(frame.boxes, frame.labels),
            title=f"step {step}, test frame {prediction.index}: scores of at least {SHOWN_SCORE}, truth dashed",
        )
    return paths
