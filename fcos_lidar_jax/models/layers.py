"""Convolution and normalisation layers.

Convolutions compute in the dtype of their input. Norms compute in at least float32 and return the dtype of their
input, so mixed precision needs only one cast after the first layer and one before the predictions.

Padding is explicit and symmetric; ``SAME`` at stride 2 would shift the receptive field. Flax's norms are not used
because XLA runs them several times slower: its group norm reshapes to two channels per group, and its batch norm
would need the stem's groups concatenated.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.collectives import mean_over_devices
from fcos_lidar_jax.initialization import kernel_init
from fcos_lidar_jax.models.convolution import Image, convolve

EPSILON = 1e-5  # Added to the variance in both norms.


def norm_groups(channels: int) -> int:
    """Number of groups of a group norm: groups of two channels, at most 32 groups."""
    return max(1, min(32, channels // 2))


class Conv(nn.Module):
    """Convolution with an optional bias, for layers without a norm."""

    features: int
    size: int = 3
    stride: int = 1
    use_bias: bool = False
    circular: bool = False
    precision: lax.Precision | None = None

    @nn.compact
    def __call__(self, x: Image) -> Image:
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", kernel_init, shape)
        y = convolve(x, kernel, stride=self.stride, circular=self.circular, precision=self.precision)
        if not self.use_bias:
            return y
        return y + self.param("bias", nn.initializers.zeros, (self.features,)).astype(y.dtype)


class BatchNorm(nn.Module):
    """Batch norm over the global batch, of an image whose channels are split into parts.

    The variance takes two passes, because the fast form loses precision on inputs in metres.
    """

    momentum: float = 0.9  # Weight of the old running statistics in an update.

    @nn.compact
    def __call__(self, parts: Sequence[Image], *, train: bool, where: Array | None = None) -> list[Image]:
        """Normalise the parts; ``where`` selects the values that enter the statistics, by default all."""
        cuts = pieces([part.shape[-1] for part in parts])
        total = cuts[-1].stop
        scale = self.param("scale", nn.initializers.ones, (total,))
        bias = self.param("bias", nn.initializers.zeros, (total,))
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, (total,))
        running_var = self.variable("batch_stats", "var", jnp.ones, (total,))
        mean, var = running_mean.value, running_var.value
        input_dtype, parts = parts[0].dtype, [at_least_float32(part) for part in parts]
        if train:
            mean = jnp.concatenate([mean_over_devices(part, (0, 1, 2), where) for part in parts])
            # The derivative of the variance by the mean is zero; omitting it saves one read of the image.
            fixed = lax.stop_gradient(mean)
            squares = [jnp.square(part - fixed[cut]) for part, cut in zip(parts, cuts, strict=True)]
            var = jnp.concatenate([mean_over_devices(square, (0, 1, 2), where) for square in squares])
            if not self.is_initializing():
                running_mean.value = self.momentum * running_mean.value + (1 - self.momentum) * mean
                running_var.value = self.momentum * running_var.value + (1 - self.momentum) * var
        gain = scale * lax.rsqrt(var + EPSILON)
        shift = bias - mean * gain
        return [(part * gain[cut] + shift[cut]).astype(input_dtype) for part, cut in zip(parts, cuts, strict=True)]


def at_least_float32(x: Array) -> Array:
    """Convert to float32 unless the dtype is at least as precise."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def pieces(sizes: Sequence[int]) -> list[slice]:
    """Make consecutive slices of the given sizes."""
    return [slice(a, b) for a, b in itertools.pairwise(itertools.accumulate(sizes, initial=0))]


class ConvNorm(nn.Module):
    """Convolution, batch norm and, by default, ReLU."""

    features: int
    size: int = 3
    stride: int = 1
    relu: bool = True
    circular: bool = False

    @nn.compact
    def __call__(self, x: Image, *, train: bool) -> Image:
        x = Conv(self.features, self.size, self.stride, circular=self.circular, name="conv")(x)
        (x,) = BatchNorm(name="norm")([x], train=train)
        return jax.nn.relu(x) if self.relu else x


def recomputed(module: nn.Module) -> Callable[..., Image]:
    """Recompute the activations of a module in the backward pass; parameters and results stay the same."""

    def call(*inputs: Any, train: bool) -> Image:
        return nn.remat(lambda module, *inputs: module(*inputs, train=train))(module, *inputs)

    return call


class GroupNorm(nn.Module):
    """Group norm with :func:`norm_groups`, statistics per image."""

    @nn.compact
    def __call__(self, x: Image) -> Image:
        input_dtype, x = x.dtype, at_least_float32(x)
        channels = x.shape[-1]
        groups = norm_groups(channels)
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))

        def group_means(per_channel: Array) -> Array:
            grouped = per_channel.reshape(x.shape[0], groups, channels // groups).mean(-1)
            return jnp.repeat(grouped, channels // groups, axis=1)[:, None, None]

        mean = group_means(x.mean((1, 2)))
        var = group_means(jnp.square(x - lax.stop_gradient(mean)).mean((1, 2)))
        gain = scale * lax.rsqrt(var + EPSILON)
        return (x * gain + (bias - mean * gain)).astype(input_dtype)
