"""Network of CenterPoint: point layers, a bird's-eye-view backbone, and heads for centres and boxes."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from fcos_lidar_jax.centerpoint.pillar_config import PillarConfig
from fcos_lidar_jax.centerpoint.pillars import cell_maxima
from fcos_lidar_jax.centerpoint.types import CentreOutputs, Pillars
from fcos_lidar_jax.collectives import sum_over_devices
from fcos_lidar_jax.models.convolution import FULL
from fcos_lidar_jax.models.heads import Predictions
from fcos_lidar_jax.models.layers import BatchNorm, Conv, ConvNorm, Image, pieces

_NUMBERS = {"offset": 2, "height": 1, "size": 3, "heading": 2, "velocity": 2}  # As ordered by ``coding.encode``.


class PointLayers(nn.Module):
    """Layers on each point, then the maximum over each pillar (PointPillars, section 2.1).

    Each layer but the last has half the channels and concatenates the maxima of the point's pillar.
    """

    channels: tuple[int, ...]
    side: int

    @nn.compact
    def __call__(self, pillars: Pillars, *, train: bool) -> Image:
        x, cell, number = pillars.features[:, :, None], pillars.cell, self.side * self.side
        inside = (cell < number)[:, :, None, None]
        where = inside | (
            sum_over_devices(inside.sum()) == 0
        )  # Without any point, the statistics are of zeros, not NaN.
        maxima = x[:, :, 0]
        for i, wide in enumerate(self.channels):
            last = i == len(self.channels) - 1
            precision = None if i else FULL
            x = Conv(wide if last else wide // 2, 1, precision=precision, name=f"linear{i}")(x)
            (x,) = BatchNorm(name=f"norm{i}")([x], train=train, where=where)
            x = jax.nn.relu(x)
            maxima = jax.vmap(cell_maxima, (0, 0, None))(x[:, :, 0], cell, number)
            if not last:
                seen = jax.vmap(lambda values, index: values[index])(maxima, cell)
                x = jnp.concatenate([x, seen[:, :, None]], axis=-1)
        return maxima[:, :-1].reshape(-1, self.side, self.side, maxima.shape[-1])


class Backbone(nn.Module):
    """Three stages of 3x3 convolutions, each starting with stride 2 (PointPillars, section 2.2)."""

    blocks: tuple[int, ...]
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Image, *, train: bool) -> list[Image]:
        """Compute the stages' outputs at 1/2, 1/4 and 1/8 of the grid size."""
        levels = []
        for stage, (count, width) in enumerate(zip(self.blocks, self.widths, strict=True)):
            for block in range(count + 1):
                x = ConvNorm(width, 3, 1 if block else 2, name=f"stage{stage}_block{block}")(x, train=train)
            levels.append(x)
        return levels


def to_channels(x: Image, factor: int) -> Image:
    """Move squares of ``factor`` x ``factor`` cells into the channels of one cell."""
    b, h, w, c = x.shape
    x = x.reshape(b, h // factor, factor, w // factor, factor, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h // factor, w // factor, -1)


def from_channels(x: Image, factor: int) -> Image:
    """Invert :func:`to_channels`.

    >>> image = jnp.arange(48.0).reshape(1, 4, 4, 3)
    >>> bool((from_channels(to_channels(image, 2), 2) == image).all())
    True
    """
    b, h, w, _ = x.shape
    x = x.reshape(b, h, w, factor, factor, -1).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(b, h * factor, w * factor, -1)


class Neck(nn.Module):
    """Resample all stages to one resolution and concatenate them.

    (Transposed) convolutions whose size equals their stride are matrix products of squares of cells.
    """

    channels: int
    stride: int  # Side of an output cell, pillars.

    @nn.compact
    def __call__(self, levels: list[Image], *, train: bool) -> Image:
        outputs = []
        for i, x in enumerate(levels):
            own, name = 2 ** (i + 1), f"level{i}"
            up, down = max(own // self.stride, 1), max(self.stride // own, 1)
            x = Conv(self.channels * up * up, 1, name=f"{name}_conv")(to_channels(x, down))
            (x,) = BatchNorm(name=f"{name}_norm")([from_channels(x, up)], train=train)
            outputs.append(jax.nn.relu(x))
        return jnp.concatenate(outputs, axis=-1)


class CentreHeads(nn.Module):
    """A shared convolution, then a heat map and box regression for each group of classes."""

    groups: tuple[int, ...]  # Group of each class.
    channels: int
    prior: float

    @nn.compact
    def __call__(self, x: Image, *, train: bool) -> CentreOutputs:
        x = ConvNorm(self.channels, name="shared")(x, train=train)
        bias, heat, regression = math.log(self.prior / (1 - self.prior)), [], []
        for group in range(max(self.groups) + 1):
            sizes = {**_NUMBERS, "heat": self.groups.count(group)}
            # The hidden layers of a group's heads are one convolution.
            hidden = ConvNorm(self.channels * len(sizes), name=f"group{group}_hidden")(x, train=train)
            predicted: dict[str, Array] = {}
            for (name, size), cut in zip(sizes.items(), pieces([self.channels] * len(sizes)), strict=True):
                biases = {name: (bias,) * size} if name == "heat" else {}
                head = Predictions({name: size}, biases, name=f"group{group}_{name}")
                predicted |= head(hidden[..., cut])
            heat.append(predicted["heat"])
            regression.append(jnp.concatenate([predicted[name] for name in _NUMBERS], axis=-1))
        by_group = sorted(range(len(self.groups)), key=lambda label: self.groups[label])
        order = [by_group.index(label) for label in range(len(self.groups))]
        return CentreOutputs(jnp.concatenate(heat, axis=-1)[..., jnp.array(order)], jnp.stack(regression, axis=-2))


class CenterPoint(nn.Module):
    """Point layers, backbone, neck and heads."""

    config: PillarConfig
    groups: tuple[int, ...]
    side: int

    def setup(self) -> None:
        c = self.config  # The attributes' names are the top level of the parameters.
        self.points = PointLayers(c.point_channels, self.side)
        self.backbone = Backbone(c.backbone_blocks, c.backbone_widths)
        self.neck = Neck(c.neck_channels, c.output_stride)
        self.heads = CentreHeads(self.groups, c.head_channels, c.centre_prior)

    def __call__(self, pillars: Pillars, *, train: bool) -> CentreOutputs:
        with jax.named_scope("points"):
            x = self.points(pillars, train=train)
        with jax.named_scope("backbone"):
            levels = self.backbone(x, train=train)
        with jax.named_scope("neck"):
            x = self.neck(levels, train=train)
        with jax.named_scope("heads"):
            return self.heads(x, train=train)
