"""Training runs of tables and studies, and training steps to be timed."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.evaluation.frames import frame_columns
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.training import Schedule, make_optimizer, make_state, make_train_step, train
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


def training_steps(
    config: Config, sensor: Sensor, frames: Sequence[Frame], variables: Variables | None = None
) -> Callable[[], dict[str, Any]]:
    """Make a function that runs one training step on a batch of the frames, by default from random weights on."""
    detector, optimizer = build_detector(config, sensor), make_optimizer(config.optimizer, 1000)
    step = jax.jit(make_train_step(detector, optimizer), donate_argnums=0)
    state = make_state(detector, optimizer, jax.random.key(0), variables=variables)
    batch = jax.device_put(make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes))

    def once() -> dict[str, Any]:
        nonlocal state
        state, metrics = step(state, batch)
        return metrics

    return once
