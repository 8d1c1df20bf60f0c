"""The parts of a detector as jitted functions, to be timed one by one."""

import functools
from collections.abc import Callable
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference import postprocess
from fcos_lidar_jax.locations import image_layout, image_sensor, locate
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.models.detector import Network, network_input
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
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
