"""LiDAR-Net's backbone: ResNet-50 without the first two downsamplings (paper, section 3.4)."""

import flax.linen as nn
import jax

from fcos_lidar_jax.models.layers import ConvNorm, Image, recomputed

STAGE_STRIDES = (1, 2, 2, 2)
_EXPANSION = 4


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions with a shortcut; the 3x3 and the shortcut have the stride."""

    width: int
    stride: int = 1
    project: bool = False
    circular: bool = False

    @nn.compact
    def __call__(self, x: Image, *, train: bool) -> Image:
        wide = self.width * _EXPANSION
        y = ConvNorm(self.width, 1, name="reduce")(x, train=train)
        y = ConvNorm(self.width, 3, self.stride, circular=self.circular, name="spatial")(y, train=train)
        y = ConvNorm(wide, 1, relu=False, name="expand")(y, train=train)
        if self.project:
            x = ConvNorm(wide, 1, self.stride, relu=False, name="shortcut")(x, train=train)
        return jax.nn.relu(x + y)


class Backbone(nn.Module):
    """A 7x7 convolution at stride 1 without pooling, and four stages."""

    blocks: tuple[int, ...]
    widths: tuple[int, ...]
    circular: bool = False
    remat: bool = False  # Recompute the largest activations: first convolution and stage.

    @nn.compact
    def __call__(self, x: Image, *, train: bool) -> list[Image]:
        """Compute C2, C3, C4 and C5 at 1/1, 1/2, 1/4 and 1/8 of the image size."""
        module = ConvNorm(x.shape[-1], 7, circular=self.circular, name="first")
        x = (recomputed(module) if self.remat else module)(x, train=train)
        levels = []
        for stage, (count, width, stride) in enumerate(zip(self.blocks, self.widths, STAGE_STRIDES, strict=True)):
            for block in range(count):
                first, name = block == 0, f"stage{stage}_block{block}"
                module = Bottleneck(width, stride if first else 1, first, self.circular, name=name)
                x = (recomputed(module) if self.remat and stage == 0 else module)(x, train=train)
            levels.append(x)
        return levels
