"""Meta-Kernel: a 3x3 convolution that knows how far its neighbours are (RangeDet, Fan et al., ICCV 2021)."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fcos_lidar_jax.models.convolution import FULL, Image, pointwise
from fcos_lidar_jax.models.layers import BatchNorm, kernel_init, normal


class Geometry(NamedTuple):
    """Where the points of an image are.

    Attributes:
        points: f[b, h, w, 3], metres, in any frame: only differences count.
        exists: f[b, h, w, 1], 1 where there is a point, else 0.
    """

    points: Float[Array, "b h w 3"]
    exists: Float[Array, "b h w 1"]


def geometry_of(image: Image, scale: tuple[float, ...]) -> Geometry:
    """The points of the first round, from the network's input, whose channels were divided by ``scale``.

    >>> geometry_of(jnp.ones((1, 1, 1, 18)), (2.0, 3.0, 4.0) + 6 * (1.0,)).points[0, 0, 0].tolist()
    [2.0, 3.0, 4.0]
    """
    rounds = image.shape[-1] // 9
    first = image[..., ::rounds]
    return Geometry(first[..., :3] * jnp.array(scale[:3], image.dtype), (first[..., 7:8] > 0).astype(image.dtype))


class MetaKernel(nn.Module):
    """A 3x3 convolution whose neighbours are weighted by an MLP of their offset in space, batch norm and ReLU.

    For a pixel i with neighbours j: ``W concat_j(MLP(p_j - p_i) * f_j)``, where the MLP has one hidden layer, as
    many channels as ``f``, and the same parameters for all neighbours. Neighbours without a point, and those of
    pixels without one, count as zeros. Offsets are metres, and the products enter the 1x1 convolution as they are;
    RangeDet's program has normalised coordinates, and a batch norm and ReLU in between.
    """

    features: int
    circular: bool = False

    @nn.compact
    def __call__(self, x: Image, geometry: Geometry, *, train: bool) -> Image:
        """The image, at stride 1."""
        channels, (height, width) = x.shape[-1], x.shape[1:3]
        hidden = self.param("hidden", _he_normal, (3, channels))
        hidden_bias = self.param("hidden_bias", nn.initializers.zeros, (channels,))
        weigh = self.param("weigh", _he_normal, (channels, channels))
        weigh_bias = self.param("weigh_bias", nn.initializers.ones, (channels,))
        kernel = self.param("kernel", kernel_init, (3, 3, channels, self.features))
        # W p_j - W p_i: the first layer is computed once a pixel, not once a neighbour. The products of
        # positions are far larger than their differences, which TF32 would round to centimetres at 50 m.
        placed = pointwise(geometry.points, hidden, precision=FULL)
        around = [self._padded(image) for image in (x * geometry.exists.astype(x.dtype), placed)]
        total = jnp.zeros((), x.dtype)
        for row in range(3):
            for column in range(3):
                f, there = (image[:, row : row + height, column : column + width] for image in around)
                weight = pointwise(jax.nn.relu(there - placed + hidden_bias), weigh) + weigh_bias
                total = total + pointwise(weight.astype(x.dtype) * f, kernel[row, column])
        total = total * geometry.exists.astype(x.dtype)
        (total,) = BatchNorm(name="norm")([total], train=train)
        return jax.nn.relu(total)

    def _padded(self, image: Image) -> Image:
        """With a pixel more on every side."""
        image = jnp.pad(image, ((0, 0), (0, 0), (1, 1), (0, 0)), mode="wrap" if self.circular else "constant")
        return jnp.pad(image, ((0, 0), (1, 1), (0, 0), (0, 0)))


def _he_normal(key: Array, shape: tuple[int, int]) -> Array:
    return normal(key, shape, jnp.sqrt(jnp.float32(2.0 / shape[0])))
