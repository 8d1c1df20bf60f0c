"""Training runs of tables and studies."""

from pathlib import Path
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.evaluation.frames import frame_columns
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.plan import RUN_SPEC
from fcos_lidar_jax.types import Detections


def trained(
    folder: Path, config: Config, frames: FrameSet, *, steps: int, seed: int, **options: Any
) -> TrainedDetector:
    """Start or resume a run in a folder and load its final detector.

    Options are passed to :func:`fcos_lidar_jax.train`, by default one device, one thread that prepares batches,
    and five checkpoints.
    """
    defaults = {"threads": 1, "devices": jax.devices()[:1], "schedule": Schedule(-(-steps // 5), steps)}
    resume = (folder / RUN_SPEC).exists()
    train(config, frames, folder, steps=steps, seed=seed, resume=resume, **{**defaults, **options})
    return load_trained(folder)


def detections(detector: TrainedDetector, frames: FrameSet) -> tuple[list[Detections], list[Frame]]:
    """Detect in frames; returns detections and frames."""
    predictions = list(predict(detector, frames))
    return [p.detections for p in predictions], [p.frame for p in predictions if p.frame is not None]


def benchmark(detections: list[Detections], frames: list[Frame]) -> Evaluation:
    """Evaluate like nuScenes' benchmark: a class without ground truth has AP 0.

    Ranges are relative to the sensor, and all attributes are wrong.
    """
    return evaluate(*frame_columns(detections, frames))
