"""Local geometry: offsets from each pixel's point to the points of the neighbouring pixels. Not in the paper.

A box is regressed from the point of one pixel, but every convolution mixes pixels whose points can be metres
apart, so the heads see little of a single pixel. Local geometry is an additional input of the heads, pixel by
pixel."""

import itertools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.models.convolution import Image, pointwise
from fcos_lidar_jax.models.layers import BatchNorm, kernel_init
from fcos_lidar_jax.types import CHANNELS

ROWS, COLUMNS = 1, 3
"""Reach of the window from its pixel."""
UNIT_M = 0.2
"""Scale of ``asinh(offset / UNIT_M)``, which is linear for small offsets and logarithmic for large ones."""
HIDDEN = 32
OWN = tuple(map(CHANNELS.index, ("z", "range", "inclination", "intensity", "existence")))


def window() -> list[tuple[int, int]]:
    """List row and column of each neighbour in the window, in the order of the channels.

    >>> len(window()), window()[0]
    (20, (0, 0))
    """
    cells = itertools.product(range(2 * ROWS + 1), range(2 * COLUMNS + 1))
    return [cell for cell in cells if cell != (ROWS, COLUMNS)]


def local_offsets(
    image: Image, *, mean: tuple[float, ...], scale: tuple[float, ...], circular: bool = False
) -> Image:
    """Compute the offsets between the first-round points of each pixel and its neighbours in a 3 x 7 window.

    Args:
        image: the network's normalised input with ``9 r`` channels, ordered by type.
        mean, scale: normalisation of the nine channels.
        circular: wrap the window around the width; otherwise there are no neighbours beyond the image.

    Returns:
        f[b, h, w, 80]: for each neighbour the radial, tangential and vertical offset relative to the azimuth of
        the pixel's point, as ``asinh(offset / UNIT_M)``, and 1. All four are 0 if one of the points is missing.

    >>> nine = (0.0,) * 9, (1.0,) * 9
    >>> wall = jnp.zeros((1, 1, 2, 9)).at[..., 0].set(jnp.array([5.0, 5.2])).at[..., 7].set(1.0)
    >>> offsets = local_offsets(wall, mean=nine[0], scale=nine[1])
    >>> (100 * offsets[0, 0, 0, 40:44]).round().tolist()  # from the left pixel to its right neighbour
    [88.0, 0.0, 0.0, 100.0]
    """
    first = image[..., :: image.shape[-1] // 9]
    exists = (first[..., 7] > 0).astype(image.dtype)
    points = [
        first[..., i] * scale[i] for i in range(3)
    ]  # Still shifted by the means, which cancel in the offsets.
    azimuth = first[..., 4] * scale[4] + mean[4]
    cos, sin = jnp.cos(azimuth), jnp.sin(azimuth)
    height, width = image.shape[1:3]

    def padded(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, ((0, 0), (0, 0), (COLUMNS, COLUMNS)), mode="wrap" if circular else "constant")
        return jnp.pad(x, ((0, 0), (ROWS, ROWS), (0, 0)))

    neighbours, neighbour_exists = [padded(x) for x in points], padded(exists)
    channels = []
    for row, column in window():
        cut = (slice(None), slice(row, row + height), slice(column, column + width))
        dx, dy, dz = (other[cut] - own for other, own in zip(neighbours, points, strict=True))
        both = neighbour_exists[cut] * exists
        offsets = cos * dx + sin * dy, cos * dy - sin * dx, dz
        channels += [*(jnp.arcsinh(offset / UNIT_M) * both for offset in offsets), both]
    return jnp.stack(channels, axis=-1)


def own_numbers(image: Image) -> Image:
    """Select height, range, inclination, intensity and existence of each pixel's first-round point.

    Channels that depend on the azimuth are left out: an object looks the same in every direction from the sensor.

    >>> own_numbers(jnp.arange(18.0).reshape(1, 1, 1, 18))[0, 0, 0].tolist()  # two rounds
    [4.0, 6.0, 10.0, 12.0, 14.0]
    """
    return image[..., :: image.shape[-1] // 9][..., np.array(OWN)]


class LocalGeometry(nn.Module):
    """Two 1x1 convolutions, each with batch norm and ReLU, of :func:`local_offsets` and :func:`own_numbers`."""

    features: int
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    circular: bool = False

    @nn.compact
    def __call__(self, image: Image, *, train: bool) -> Image:
        offsets = local_offsets(image, mean=self.mean, scale=self.scale, circular=self.circular)
        x = jnp.concatenate([offsets, own_numbers(image)], axis=-1)
        for layer, width in enumerate((HIDDEN, self.features)):
            kernel = self.param(f"linear{layer}", kernel_init, (x.shape[-1], width))
            (x,) = BatchNorm(name=f"norm{layer}")([pointwise(x, kernel)], train=train)
            x = jax.nn.relu(x)
        return x
