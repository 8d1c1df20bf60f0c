"""The parts of a detector as jitted functions, to be timed one by one."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.inference import postprocess
from fcos_lidar_jax.locations import image_layout, image_sensor, locate
from fcos_lidar_jax.models import Variables
from fcos_lidar_jax.models.detector import network_input
from fcos_lidar_jax.models.fpn import FeaturePyramid
from fcos_lidar_jax.models.heads import Heads
from fcos_lidar_jax.models.lidar_net import Backbone
from fcos_lidar_jax.models.modality import Stem
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Outputs, RangeImage


@dataclasses.dataclass(frozen=True)
class Stages:
    """Jitted functions; those of the network take all its variables."""

    project: Callable[..., RangeImage]
    """Points and their validity to a range image."""
    preprocess: Callable[..., jax.Array]
    """Features f32[b, h, w, 9, r] to the network's input."""
    stem: Callable[..., jax.Array]
    backbone: Callable[..., Any]
    fpn: Callable[..., Any]
    heads: Callable[..., Outputs]
    postprocess: Callable[..., Any]
    """Outputs of one sample and its range image to boxes."""


def make_stages(config: Config, sensor: Sensor) -> Stages:
    """The parts of a configuration's detector."""
    model, binned, layout = config.model, image_sensor(sensor, config.model), image_layout(sensor, config.model)
    circular, projection = model.circular_width, config.projection
    rounds, current = projection.num_rounds, projection.prioritize_current
    stem = Stem(model.stem, circular, model.precision)
    backbone = Backbone(model.backbone_blocks, model.backbone_widths, circular)
    fpn = FeaturePyramid(model.fpn_channels, circular)
    heads = Heads(
        len(config.classes),
        model.head_channels,
        model.head_convs,
        model.background_prior,
        model.tied_heads,
        circular,
    )

    def of(part: str, v: Variables) -> Variables:
        return {kind: tree[part] for kind, tree in v.items() if part in tree}

    return Stages(
        project=jax.jit(
            lambda p, valid: project_points(p, valid, binned, num_rounds=rounds, prioritize_current=current)
        ),
        preprocess=jax.jit(lambda features: network_input(features, model, layout)),
        stem=jax.jit(lambda v, x: stem.apply(of("stem", v), x, train=False)),
        backbone=jax.jit(lambda v, x: backbone.apply(of("backbone", v), x, train=False)),
        fpn=jax.jit(lambda v, x: fpn.apply(of("fpn", v), x)),
        heads=jax.jit(lambda v, x: heads.apply(of("heads", v), x)),
        postprocess=jax.jit(
            lambda outputs, image: postprocess(
                outputs, locate(image, layout), config=config.inference, layout=layout
            )
        ),
    )
