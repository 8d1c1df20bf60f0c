"""Training runs of tables and studies: begun or resumed, loaded, evaluated."""

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
    """The detector at the end of a run in a folder, which is begun, resumed or found finished.

    Options are those of :func:`fcos_lidar_jax.train`; by default one device, one thread that prepares
    batches, and five checkpoints.
    """
    defaults = {"threads": 1, "devices": jax.devices()[:1], "schedule": Schedule(-(-steps // 5), steps)}
    resume = (folder / RUN_SPEC).exists()
    train(config, frames, folder, steps=steps, seed=seed, resume=resume, **{**defaults, **options})
    return load_trained(folder)


def detections(detector: TrainedDetector, frames: FrameSet) -> tuple[list[Detections], list[Frame]]:
    """What a detector finds in frames, and the frames, of one process."""
    predictions = list(predict(detector, frames))
    return [p.detections for p in predictions], [p.frame for p in predictions if p.frame is not None]


def benchmark(found: list[Detections], frames: list[Frame]) -> Evaluation:
    """The sums of nuScenes' benchmark: a class without truth has AP 0. The ranges count from the sensor, and every
    attribute is wrong."""
    return evaluate(*frame_columns(found, frames))
