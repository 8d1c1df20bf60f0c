"""The parts of a detector as jitted functions, to be timed one by one."""

from collections.abc import Callable
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.models.detector import Network, network_input
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Outputs, RangeImage


class Stages:
    """The parts of a configuration's detector as jitted functions; those of the network take all its variables."""

    def __init__(self, config: Config, sensor: Sensor) -> None:
        model, layout = config.model, image_layout(sensor, config.model)
        stages, network = make_stages(build_detector(config, sensor)), Network(model, len(config.classes))

        def part(name: str, **options: Any) -> Callable[..., Any]:
            def apply(variables: Variables, x: Any) -> Any:
                return network.apply(variables, x, method=lambda whole, x: getattr(whole, name)(x, **options))

            return jax.jit(apply)

        self.project, self.postprocess = jax.jit(stages.prepare), jax.jit(stages.postprocess)
        self.preprocess = jax.jit(lambda features: network_input(features, model, layout))
        self.stem, self.backbone = part("stem", train=False), part("backbone", train=False)
        self.fpn, self.heads = part("fpn"), part("heads")

    def outputs(self, variables: Variables, image: RangeImage) -> Outputs:
        """The network's outputs for one sample."""
        x = self.stem(variables, self.preprocess(image.features[None]))
        outputs = self.heads(variables, self.fpn(variables, self.backbone(variables, x)))
        return jax.tree.map(lambda leaf: leaf[0], outputs)
