"""Training steps to be timed."""

from collections.abc import Callable, Sequence
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step


def training_steps(
    config: Config, sensor: Sensor, frames: Sequence[Frame], variables: Variables | None = None
) -> Callable[[], dict[str, Any]]:
    """Make a function that runs one training step on a batch of the frames and returns its metrics.

    It starts from ``variables``, by default random ones.
    """
    detector, optimizer = build_detector(config, sensor), make_optimizer(config.optimizer, 1000)
    step = jax.jit(make_train_step(detector, optimizer), donate_argnums=0)
    state = make_state(detector, optimizer, jax.random.key(0), variables=variables)
    batch = jax.device_put(make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes))

    def once() -> dict[str, Any]:
        nonlocal state
        state, metrics = step(state, batch)
        return metrics

    return once
