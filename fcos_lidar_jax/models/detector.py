"""Detectors as pure functions, and the network of FCOS-LiDAR."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32

from fcos_lidar_jax.config import Config, ModelConfig
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.initialization import init_variables
from fcos_lidar_jax.locations import STRIDES, ImageLayout, image_layout, image_sensor, locate, pad_image
from fcos_lidar_jax.models.candidates import select_candidates
from fcos_lidar_jax.models.fpn import FeaturePyramid
from fcos_lidar_jax.models.heads import Heads
from fcos_lidar_jax.models.layers import Image, recomputed
from fcos_lidar_jax.models.lidar_net import Backbone
from fcos_lidar_jax.models.local_geometry import LocalGeometry
from fcos_lidar_jax.models.modality import Stem
from fcos_lidar_jax.models.objective import make_sums
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.refinement import add_refinement
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CHANNELS, Batch, Outputs, RangeImage, Sums

Variables = dict[str, Any]  # ``params`` and ``batch_stats``, plain dicts of arrays.


class Detector(NamedTuple):
    """A detector as pure functions, with its configuration and sensor.

    Attributes:
        prepare: ``(points f32[n, c], valid bool[n]) -> input`` converts one cloud to the network's input: a pytree
            with ``num_dropped`` i32[], the number of excluded valid points. FCOS-LiDAR's is a
            :class:`~fcos_lidar_jax.types.RangeImage`.
        init: ``key -> variables``.
        apply: ``(variables, inputs, train=False) -> (outputs, batch_stats)`` for a batch of inputs. The batch
            statistics are unchanged unless training. FCOS-LiDAR's outputs are
            :class:`~fcos_lidar_jax.types.Outputs`.
        sums: ``(variables, outputs, inputs, batch) -> Sums``, the losses of a batch.
        candidates: ``(outputs, input) -> (boxes f32[c, 9], scores f32[c], labels i32[c], valid bool[c])`` for one
            cloud, before NMS.
        config: the configuration.
        sensor: the sensor whose clouds it takes.
        refine: ``(variables, points f32[n, c], valid bool[n], boxes, scores, labels, valid) -> (boxes, scores,
            labels, valid)`` for one cloud, after NMS; None without a second look.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import SHORT_RANGE
    >>> detector = build_detector(QUICKSTART, SHORT_RANGE)
    >>> variables = jax.eval_shape(detector.init, jax.random.key(0))
    >>> clouds = jax.ShapeDtypeStruct((2, 4096, 5), jnp.float32), jax.ShapeDtypeStruct((2, 4096), bool)
    >>> images = jax.eval_shape(jax.vmap(detector.prepare), *clouds)
    >>> outputs, _ = jax.eval_shape(detector.apply, variables, images)
    >>> outputs.logits.shape  # locations of all levels; ten classes and the background
    (2, 5460, 11)
    """

    prepare: Callable[..., Any]
    init: Callable[[Any], Variables]
    apply: Callable[..., tuple[Any, Any]]
    sums: Callable[[Variables, Any, Any, Batch], Sums]
    candidates: Callable[[Any, Any], tuple[Array, Array, Array, Array]]
    config: Config
    sensor: Sensor
    refine: Callable[..., tuple[Array, Array, Array, Array]] | None = None


class Network(nn.Module):
    """Stem, backbone, feature pyramid and heads."""

    config: ModelConfig
    num_classes: int

    def setup(self) -> None:
        c = self.config  # The attributes' names are the top level of the parameters.
        self.stem = Stem(c.stem, c.circular_width, c.precision, len(c.channel_mean))
        if c.local_geometry:
            normalisation = c.channel_mean, c.channel_scale
            self.local_geometry = LocalGeometry(
                c.fpn_channels, *normalisation, c.circular_width, later_rounds=c.round_offsets
            )
        self.backbone = Backbone(c.backbone_blocks, c.backbone_widths, c.circular_width, c.remat)
        self.fpn = FeaturePyramid(c.fpn_channels, c.circular_width)
        self.heads = Heads(
            self.num_classes, c.head_channels, c.head_convs, c.background_prior, c.tied_heads, c.circular_width
        )

    def __call__(self, image: Image, *, train: bool) -> Outputs:
        with jax.named_scope("stem"):
            x = (recomputed(self.stem) if self.config.remat else self.stem)(image, train=train)
        with jax.named_scope("backbone"):
            levels = self.backbone(x, train=train)
        with jax.named_scope("fpn"):
            levels = self.fpn(levels)
        local = None
        if self.config.local_geometry:
            with jax.named_scope("local_geometry"):
                features = self.local_geometry(image, train=train)
            local = [features[:, ::stride, ::stride] for stride in STRIDES]
        with jax.named_scope("heads"):
            return self.heads(levels, local)


def network_input(features: Float32[Array, "b h w c r"], config: ModelConfig, layout: ImageLayout) -> Image:
    """Preprocess range images: normalise, repeat rows, pad, and join channel types and rounds.

    Empty slots stay zero in all channels. The ``c r`` channels of the result are ordered by type, then by round
    (paper, figure 2).
    """
    number = len(config.channel_mean)
    check(features.shape[-2] == number, "features", features.shape, f"{number} channels, as in channel_mean")
    mean = jnp.array(config.channel_mean, jnp.float32)[:, None]
    scale = jnp.array(config.channel_scale, jnp.float32)[:, None]
    exists = features[..., 7:8, :] > 0
    image = pad_image(jnp.where(exists, (features - mean) / scale, 0.0), layout)
    return image.reshape(*image.shape[:3], -1)


@functools.cache
def build_detector(config: Config, sensor: Sensor) -> Detector:
    """Build the detector of a configuration for a sensor; equal arguments share one object and its programs.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> from fcos_lidar_jax.sensors import TINY
    >>> detector = build_detector(QUICKSTART, TINY)
    >>> sorted(jax.eval_shape(detector.init, jax.random.key(0)))
    ['batch_stats', 'params']
    """
    detector = config.build(sensor) or _build(config, sensor)
    return detector if config.refinement is None else add_refinement(detector)


def _build(config: Config, sensor: Sensor) -> Detector:
    """FCOS-LiDAR without a second look."""
    network, layout = Network(config.model, len(config.classes)), image_layout(sensor, config.model)
    projection, sensor_of_image = config.projection, image_sensor(sensor, config.model)
    kinds = len(config.model.channel_mean)
    options = {"num_rounds": projection.num_rounds, "prioritize_current": projection.prioritize_current}

    def prepare(points: Array | np.ndarray, valid: Array | np.ndarray) -> RangeImage:
        with jax.named_scope("mrv"):
            image = project_points(points, valid, sensor_of_image, **options)
        # A detector may be older than the last channels.
        features = image.features if kinds >= len(CHANNELS) else image.features[:, :, :kinds]
        return dataclasses.replace(image, features=features)

    def init(key: Any) -> Variables:
        image = jax.ShapeDtypeStruct((1, 32, 32, kinds * projection.num_rounds), jnp.float32)
        plain = Network(dataclasses.replace(config.model, remat=False), len(config.classes))  # the same variables
        return init_variables(plain, key, image)

    def apply(variables: Variables, images: RangeImage, *, train: bool = False) -> tuple[Outputs, Any]:
        # The image takes the parameters' dtype, so that float64 parameters make the whole network float64.
        image = network_input(images.features, config.model, layout)
        image = image.astype(jax.tree.leaves(variables["params"])[0].dtype)
        outputs, updates = network.apply(variables, image, train=train, mutable=["batch_stats"] if train else [])
        return outputs, updates["batch_stats"] if train else variables["batch_stats"]

    def candidates(outputs: Outputs, image: RangeImage) -> tuple[Array, Array, Array, Array]:
        axes = config.model.regression_axes
        return select_candidates(outputs, locate(image, layout), config=config.inference, layout=layout, axes=axes)

    return Detector(prepare, init, apply, make_sums(config, sensor), candidates, config, sensor)


def count_parameters(params: Any) -> dict[str, int]:
    """Count the parameters of each part of the network, and in total."""
    parts = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in params.items()}
    return {**parts, "total": sum(parts.values())}
