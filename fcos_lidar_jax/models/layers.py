"""Convolution and norms as the network needs them.

A convolution computes in the type of its input; norms compute in float32 at least and give the type of their
input back: mixed precision is one cast behind the first layer and one before the predictions.

Padding is explicit and the same on both sides (``SAME`` at stride 2 would shift the receptive field).
The norms are written out because XLA is several times slower on the library's forms: a group norm reshaped to
two channels a group, and a batch norm that would need the stem's groups concatenated.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from fcos_lidar_jax.models.convolution import Image, convolve

EPSILON = 1e-5  # Of the variances of both norms.


def norm_groups(channels: int) -> int:
    """Groups of a group norm: two channels each, at most 32."""
    return max(1, min(32, channels // 2))


def normal(key: Array, shape: Sequence[int], stddev: Any) -> Array:
    """``stddev * jax.random.normal(key, shape)``, to the bit; compiled for powers of two instead of for every
    shape, for XLA takes seconds to compile each on a CPU."""
    size = math.prod(shape)
    return jax.random.normal(key, (1 << (size - 1).bit_length(),))[:size].reshape(shape) * stddev


def kernel_init(key: Array, shape: Sequence[int]) -> Array:
    """He's, over the outputs, as in ResNet."""
    return normal(key, shape, jnp.sqrt(jnp.float32(2.0 / math.prod((*shape[:-2], shape[-1])))))


class Conv(nn.Module):
    """A convolution with its kernel and, where no norm follows, a bias."""

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
    """Batch norm of an image whose channels come in parts, over the global batch.

    The variance is of two passes: the fast form cancels badly on metre-scale inputs.
    """

    momentum: float = 0.9  # Part of the running statistics that an update keeps.

    @nn.compact
    def __call__(self, parts: Sequence[Image], *, train: bool, where: Array | None = None) -> list[Image]:
        """The parts, normalised; only what ``where`` marks, by default everything, enters the statistics."""
        cuts = pieces([part.shape[-1] for part in parts])
        total = cuts[-1].stop
        scale = self.param("scale", nn.initializers.ones, (total,))
        bias = self.param("bias", nn.initializers.zeros, (total,))
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, (total,))
        running_var = self.variable("batch_stats", "var", jnp.ones, (total,))
        mean, var = running_mean.value, running_var.value
        given, parts = parts[0].dtype, [at_least_float32(part) for part in parts]
        if train:
            mean = jnp.concatenate([part.mean((0, 1, 2), where=where) for part in parts])
            # Its derivative by the mean is zero; left out, the backward pass reads the image once less.
            fixed = lax.stop_gradient(mean)
            squares = [jnp.square(part - fixed[cut]) for part, cut in zip(parts, cuts, strict=True)]
            var = jnp.concatenate([square.mean((0, 1, 2), where=where) for square in squares])
            if not self.is_initializing():
                running_mean.value = self.momentum * running_mean.value + (1 - self.momentum) * mean
                running_var.value = self.momentum * running_var.value + (1 - self.momentum) * var
        gain = scale * lax.rsqrt(var + EPSILON)
        shift = bias - mean * gain
        return [(part * gain[cut] + shift[cut]).astype(given) for part, cut in zip(parts, cuts, strict=True)]


def at_least_float32(x: Array) -> Array:
    """The same, in float32 if it was less precise."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def pieces(sizes: Sequence[int]) -> list[slice]:
    """Consecutive slices of the given sizes.

    >>> pieces([2, 3])
    [slice(0, 2, None), slice(2, 5, None)]
    """
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
    """The module with the same parameters and results; the backward pass computes its activations again."""

    def call(*given: Any, train: bool) -> Image:
        return nn.remat(lambda module, *given: module(*given, train=train))(module, *given)

    return call


class GroupNorm(nn.Module):
    """Group norm with :func:`norm_groups`, statistics per image."""

    @nn.compact
    def __call__(self, x: Image) -> Image:
        given, x = x.dtype, at_least_float32(x)
        channels = x.shape[-1]
        groups = norm_groups(channels)
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))

        def of_group(per_channel: Array) -> Array:
            grouped = per_channel.reshape(x.shape[0], groups, channels // groups).mean(-1)
            return jnp.repeat(grouped, channels // groups, axis=1)[:, None, None]

        mean = of_group(x.mean((1, 2)))
        var = of_group(jnp.square(x - lax.stop_gradient(mean)).mean((1, 2)))
        gain = scale * lax.rsqrt(var + EPSILON)
        return (x * gain + (bias - mean * gain)).astype(given)
