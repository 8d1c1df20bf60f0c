"""Training runs of tables and studies: begun or resumed, loaded, evaluated."""

from pathlib import Path
from typing import Any

import jax

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.evaluation.frames import evaluate_frames, frame_columns
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate, metric_of
from fcos_lidar_jax.inference import TrainedDetector, load_detector
from fcos_lidar_jax.trainer import Schedule, predict, train
from fcos_lidar_jax.trainer.run import RUN_SPEC
from fcos_lidar_jax.types import Detections


def trained(
    folder: Path, config: Config, frames: FrameSet, *, steps: int, seed: int, **options: Any
) -> TrainedDetector:
    """The detector at the end of a run, which is begun, resumed or found finished.

    Args:
        folder: of the run.
        config: that is trained.
        frames: that it is trained on.
        steps: of the run.
        seed: of the run.
        options: of :func:`fcos_lidar_jax.trainer.train`; by default one device, one thread that prepares batches,
            and five checkpoints.
    """
    defaults = {"threads": 1, "devices": jax.devices()[:1], "schedule": Schedule(-(-steps // 5), steps)}
    resume = (folder / RUN_SPEC).exists()
    train(config, frames, folder, steps=steps, seed=seed, resume=resume, **{**defaults, **options})
    return load_detector(folder)


def detections(detector: TrainedDetector, frames: FrameSet) -> tuple[list[Detections], list[Frame]]:
    """What a detector finds in frames, and the frames, of one process."""
    predictions = list(predict(detector, frames))
    return [p.detections for p in predictions], [p.frame for p in predictions if p.frame is not None]


def mean_ap(found: list[Detections], frames: list[Frame]) -> float:
    """Mean average precision over those of nuScenes' classes that occur in the frames."""
    return evaluate_frames(found, frames, metric_of(NUSCENES_CLASSES)).summary["mean_ap"]


def benchmark(found: list[Detections], frames: list[Frame]) -> Evaluation:
    """The sums of nuScenes' benchmark: a class without truth has AP 0. The ranges count from the sensor, and every
    attribute is wrong."""
    return evaluate(*frame_columns(found, frames))
