"""Local geometry: where the points around a pixel lie, seen from its own point. Not in the paper."""

import itertools

import flax.linen as nn
import jax
import jax.numpy as jnp

from fcos_lidar_jax.models.convolution import Image, pointwise
from fcos_lidar_jax.models.layers import BatchNorm, kernel_init

ROWS, COLUMNS = 1, 3
"""How far the window reaches from its pixel."""
UNIT_M = 0.2
"""Offsets are compressed by ``asinh(offset / UNIT_M)``: linear below a decimetre or two, logarithmic beyond."""
HIDDEN = 32


def window() -> list[tuple[int, int]]:
    """Row and column of every neighbour within the padded window, in the order of its channels.

    >>> len(window()), window()[0]
    (20, (0, 0))
    """
    cells = itertools.product(range(2 * ROWS + 1), range(2 * COLUMNS + 1))
    return [cell for cell in cells if cell != (ROWS, COLUMNS)]


def local_offsets(
    image: Image, *, mean: tuple[float, ...], scale: tuple[float, ...], circular: bool = False
) -> Image:
    """Offsets from each pixel's first-round point to those of its neighbours in a window of 3 x 7 pixels.

    Args:
        image: the network's input, ``9 r`` channels, normalised, those of one type adjacent.
        mean, scale: what the nine channels were shifted and divided by.
        circular: the window wraps around the width; else there is nothing beside the image.

    Returns:
        f[b, h, w, 80]: per neighbour the radial, tangential and vertical offset, along the azimuth of the pixel's
        point, as ``asinh(offset / UNIT_M)``, and 1 where both points exist; all four are 0 where one is missing.

    >>> nine = (0.0,) * 9, (1.0,) * 9
    >>> wall = jnp.zeros((1, 1, 2, 9)).at[..., 0].set(jnp.array([5.0, 5.2])).at[..., 7].set(1.0)
    >>> offsets = local_offsets(wall, mean=nine[0], scale=nine[1])
    >>> (100 * offsets[0, 0, 0, 40:44]).round().tolist()  # from the left pixel to its right neighbour
    [88.0, 0.0, 0.0, 100.0]
    """
    first = image[..., :: image.shape[-1] // 9]
    exists = (first[..., 7] > 0).astype(image.dtype)
    points = [first[..., i] * scale[i] for i in range(3)]  # Shifted by the means: only differences count.
    azimuth = first[..., 4] * scale[4] + mean[4]
    cos, sin = jnp.cos(azimuth), jnp.sin(azimuth)
    height, width = image.shape[1:3]

    def padded(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, ((0, 0), (0, 0), (COLUMNS, COLUMNS)), mode="wrap" if circular else "constant")
        return jnp.pad(x, ((0, 0), (ROWS, ROWS), (0, 0)))

    around, there = [padded(x) for x in points], padded(exists)
    channels = []
    for row, column in window():
        cut = (slice(None), slice(row, row + height), slice(column, column + width))
        dx, dy, dz = (other[cut] - own for other, own in zip(around, points, strict=True))
        both = there[cut] * exists
        offsets = cos * dx + sin * dy, cos * dy - sin * dx, dz
        channels += [*(jnp.arcsinh(offset / UNIT_M) * both for offset in offsets), both]
    return jnp.stack(channels, axis=-1)


class LocalGeometry(nn.Module):
    """Features of :func:`local_offsets`, to be added to the stem's: two 1x1 convolutions with batch norm and ReLU.

    The raw coordinates of neighbours are metres apart from zero and decimetres from each other: the differences,
    which are what an object looks like, are lost in them.
    """

    features: int
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    circular: bool = False

    @nn.compact
    def __call__(self, image: Image, *, train: bool) -> Image:
        x = local_offsets(image, mean=self.mean, scale=self.scale, circular=self.circular)
        for layer, width in enumerate((HIDDEN, self.features)):
            kernel = self.param(f"linear{layer}", kernel_init, (x.shape[-1], width))
            (x,) = BatchNorm(name=f"norm{layer}")([pointwise(x, kernel)], train=train)
            x = jax.nn.relu(x)
        return x
