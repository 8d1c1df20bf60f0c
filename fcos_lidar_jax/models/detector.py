"""The network as a pair of pure functions."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32

from fcos_lidar_jax.config import Config, ModelConfig
from fcos_lidar_jax.locations import STRIDES, ImageLayout, image_layout, pad_image
from fcos_lidar_jax.models.centerpoint import build_centerpoint
from fcos_lidar_jax.models.fpn import FeaturePyramid
from fcos_lidar_jax.models.heads import Heads
from fcos_lidar_jax.models.layers import Image, recomputed
from fcos_lidar_jax.models.lidar_net import Backbone
from fcos_lidar_jax.models.local_geometry import LocalGeometry
from fcos_lidar_jax.models.meta_kernel import geometry_of
from fcos_lidar_jax.models.modality import Stem
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Outputs

Variables = dict[str, Any]  # ``params`` and ``batch_stats``, plain dicts of arrays.


class Detector(NamedTuple):
    """The network's two pure functions, with the configuration and the sensor that they were built for.

    Attributes:
        init: ``key -> variables``.
        apply: ``(variables, features f32[b, h, w, 9, r], train=False) -> (Outputs, batch_stats)``. The
            features are a range image's, in raw units; the batch statistics are the given ones unless training.
            With ``config.pillars``: ``(variables, Pillars, train=False) -> (CentreOutputs, batch_stats)``.
        config: all choices.
        sensor: the image's geometry.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> detector = build_detector(QUICKSTART, SHORT_RANGE)
    >>> variables = jax.eval_shape(detector.init, jax.random.key(0))
    >>> image = jax.ShapeDtypeStruct((1, 32, 128, 9, 1), jnp.float32)
    >>> outputs, _ = jax.eval_shape(detector.apply, variables, image)
    >>> outputs.logits.shape  # all levels' locations; ten classes and the background
    (1, 5460, 11)
    """

    init: Callable[[Any], Variables]
    apply: Callable[..., tuple[Any, Any]]
    config: Config
    sensor: Sensor


class Network(nn.Module):
    """Stem, backbone, feature pyramid and heads."""

    config: ModelConfig
    num_classes: int

    def setup(self) -> None:
        c = self.config  # the names are the top level of the parameters
        self.stem = Stem(c.stem, c.circular_width, c.precision)
        if c.local_geometry:
            normalised = c.channel_mean, c.channel_scale
            self.local_geometry = LocalGeometry(c.fpn_channels, *normalised, c.circular_width)
        self.backbone = Backbone(c.backbone_blocks, c.backbone_widths, c.circular_width, c.remat)
        self.fpn = FeaturePyramid(c.fpn_channels, c.circular_width)
        sizes = self.num_classes, c.head_channels, c.head_convs
        self.heads = Heads(*sizes, c.background_prior, c.tied_heads, c.circular_width)

    def __call__(self, image: Image, *, train: bool) -> Outputs:
        with jax.named_scope("stem"):
            x = (recomputed(self.stem) if self.config.remat else self.stem)(image, train=train)
        with jax.named_scope("backbone"):
            geometry = geometry_of(image, self.config.channel_scale) if self.config.meta_kernel else None
            levels = self.backbone(x, geometry, train=train)
        with jax.named_scope("fpn"):
            levels = self.fpn(levels)
        local = None
        if self.config.local_geometry:
            with jax.named_scope("local_geometry"):
                features = self.local_geometry(image, train=train)
            local = [features[:, ::stride, ::stride] for stride in STRIDES]
        with jax.named_scope("heads"):
            return self.heads(levels, local)


def network_input(features: Float32[Array, "b h w 9 r"], config: ModelConfig, layout: ImageLayout) -> Image:
    """Preprocessing of a range image: normalise, repeat rows, pad, join channel types and rounds.

    Empty slots stay zero in all nine channels. Of the ``9 r`` channels of the result those of one type are
    adjacent (paper, figure 2).

    >>> network_input(jnp.zeros((1, 16, 256, 9, 2)), ModelConfig(), ImageLayout(16, 256, 2)).shape
    (1, 32, 256, 18)
    """
    mean = jnp.array(config.channel_mean, jnp.float32)[:, None]
    scale = jnp.array(config.channel_scale, jnp.float32)[:, None]
    exists = features[..., 7:8, :] > 0
    image = pad_image(jnp.where(exists, (features - mean) / scale, 0.0), layout)
    return image.reshape(*image.shape[:3], -1)


@functools.cache
def build_detector(config: Config, sensor: Sensor) -> Detector:
    """The network of a configuration for a sensor's clouds; equal arguments share one object and its programs.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import TINY
    >>> detector = build_detector(QUICKSTART, TINY)
    >>> sorted(jax.eval_shape(detector.init, jax.random.key(0)))
    ['batch_stats', 'params']
    """
    if config.pillars is not None:
        return Detector(*build_centerpoint(config, sensor), config, sensor)
    network = Network(config.model, len(config.classes))
    layout = image_layout(sensor, config.model)
    channels = 9 * config.projection.num_rounds

    def init(key: Any) -> Variables:
        # Parameters do not depend on the image's size, and nothing of the forward pass is computed.
        image = jax.ShapeDtypeStruct((1, 32, 32, channels), jnp.float32)
        return network.lazy_init(key, image, train=False)  # type: ignore[return-value]

    def apply(
        variables: Variables, features: Float32[Array, "b h w 9 r"], *, train: bool = False
    ) -> tuple[Outputs, Any]:
        # The image takes the parameters' type: float64 ones make everything behind it float64.
        image = network_input(features, config.model, layout)
        image = image.astype(jax.tree.leaves(variables["params"])[0].dtype)
        outputs, updates = network.apply(variables, image, train=train, mutable=["batch_stats"] if train else [])
        return outputs, updates["batch_stats"] if train else variables["batch_stats"]

    return Detector(init, apply, config, sensor)


def count_parameters(params: Any) -> dict[str, int]:
    """Parameters of each part of the network, and in total.

    >>> count_parameters({"stem": {"kernel": jnp.ones((3, 4))}, "fpn": {"bias": jnp.ones(2)}})
    {'stem': 12, 'fpn': 2, 'total': 14}
    """
    parts = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in params.items()}
    return {**parts, "total": sum(parts.values())}
