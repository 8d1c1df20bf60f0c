"""The parts of a detector as jitted functions, and its training step, to be timed one by one."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.inference import postprocess
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.locations import image_layout, image_sensor, locate
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.models.detector import Network, network_input
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.types import Outputs, RangeImage


class Stages:
    """The parts of a configuration's detector as jitted functions; those of the network take all its variables."""

    def __init__(self, config: Config, sensor: Sensor) -> None:
        model, layout, projection = config.model, image_layout(sensor, config.model), config.projection
        binned, network = image_sensor(sensor, model), Network(model, len(config.classes))

        def part(name: str, **options: Any) -> Callable[..., Any]:
            def apply(variables: Variables, x: Any) -> Any:
                return network.apply(variables, x, method=lambda whole, x: getattr(whole, name)(x, **options))

            return jax.jit(apply)

        project = functools.partial(project_points, sensor=binned, num_rounds=projection.num_rounds)
        self.project = jax.jit(functools.partial(project, prioritize_current=projection.prioritize_current))
        self.preprocess = jax.jit(lambda features: network_input(features, model, layout))
        self.stem, self.backbone = part("stem", train=False), part("backbone", train=False)
        self.fpn, self.heads = part("fpn"), part("heads")

        select = functools.partial(postprocess, config=config.inference, layout=layout)
        self.postprocess = jax.jit(lambda outputs, image: select(outputs, locate(image, layout)))

    def outputs(self, variables: Variables, image: RangeImage) -> Outputs:
        """The network's outputs for one sample."""
        x = self.stem(variables, self.preprocess(image.features[None]))
        outputs = self.heads(variables, self.fpn(variables, self.backbone(variables, x)))
        return jax.tree.map(lambda leaf: leaf[0], outputs)


def training_steps(config: Config, sensor: Sensor, frames: Sequence[Frame]) -> Callable[[], dict[str, Any]]:
    """Whole training steps on one batch of the frames, one a call, which returns the metrics."""
    detector, optimizer = build_detector(config, sensor), make_optimizer(config.optimizer, 1000)
    step = jax.jit(make_train_step(detector, optimizer), donate_argnums=0)
    state = make_state(detector, optimizer, jax.random.key(0))
    batch = jax.device_put(make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes))

    def once() -> dict[str, Any]:
        nonlocal state
        state, metrics = step(state, batch)
        return metrics

    return once
