"""Pictures of a run: curves of its metrics, and what it finds in a few test frames."""

from collections.abc import Iterable
from pathlib import Path

from fcos_lidar_jax.data.frame import FrameSet
from fcos_lidar_jax.inference.records import confident
from fcos_lidar_jax.trainer.prediction import Prediction
from fcos_lidar_jax.training.metrics_log import read_metrics

_SHOWN_SCORE = 0.2


def draw_metrics(folder: Path) -> None:
    """The losses and, where there is one, the mean average precision over the steps.

    Args:
        folder: of the run; gets ``loss.png`` and ``scores.png``.
    """
    from fcos_lidar_jax.visualization.curves import draw_curves

    lines = read_metrics(folder)
    parts = ("total", "classification", "l1", "iou", "iou_prediction")
    losses = {p: [(line["step"], line[f"loss/{p}"]) for line in lines if f"loss/{p}" in line] for p in parts}
    draw_curves(folder / "loss.png", losses, x_label="step", y_label="loss", title="training", log_y=True)
    scores = {"mAP": [(line["step"], line["test/mAP"]) for line in lines if "test/mAP" in line]}
    if scores["mAP"]:
        draw_curves(folder / "scores.png", scores, x_label="step", y_label="", title="test frames")


def draw_predictions(folder: Path, predictions: Iterable[Prediction], frames: FrameSet, step: int) -> None:
    """Test frames from above, with detections and truth.

    Args:
        folder: made if missing.
        predictions: in some of the frames.
        frames: with boxes of the detector's classes.
        step: updates done.
    """
    from fcos_lidar_jax.visualization.bev import draw_bev

    folder.mkdir(exist_ok=True)
    for prediction in predictions:
        frame = prediction.frame or frames.frame(prediction.index)
        draw_bev(
            frame.points,
            folder / f"step_{step:06d}_frame_{prediction.index}.png",
            limit_m=frames.sensor.limit_xy_m,
            classes=frames.classes,
            detections=confident(prediction.detections, _SHOWN_SCORE),
            truth=(frame.boxes, frame.labels),
            title=f"step {step}, test frame {prediction.index}: score {_SHOWN_SCORE} and more, truth dashed",
        )
