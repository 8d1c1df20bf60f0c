"""Local geometry: offsets from each pixel's point to the points of the neighbouring pixels. Not in the paper.

A box is regressed from the point of one pixel, but every convolution mixes pixels whose points can be metres
apart, so the heads see little of a single pixel. Local geometry is an additional input of the heads, pixel by
pixel."""

import itertools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from fcos_lidar_jax.initialization import kernel_init
from fcos_lidar_jax.models.convolution import FULL, Image, pointwise
from fcos_lidar_jax.models.layers import BatchNorm
from fcos_lidar_jax.types import CHANNELS

ROWS, COLUMNS = 1, 3
"""Reach of the window from its pixel."""
UNIT_M = 0.2
"""Scale of ``asinh(offset / UNIT_M)``, which is linear for small offsets and logarithmic for large ones."""
HIDDEN = 32
OWN = tuple(map(CHANNELS.index, ("z", "range", "inclination", "intensity", "existence")))


def window() -> list[tuple[int, int]]:
    """List row and column of each neighbour in the window, in the order of the channels."""
    cells = itertools.product(range(2 * ROWS + 1), range(2 * COLUMNS + 1))
    return [cell for cell in cells if cell != (ROWS, COLUMNS)]


def local_offsets(
    image: Image, *, mean: tuple[float, ...], scale: tuple[float, ...], circular: bool = False
) -> Image:
    """Compute the offsets between the first-round points of each pixel and its neighbours in a 3 x 7 window.

    Args:
        image: the network's normalised input, with r rounds of each channel, ordered by type.
        mean, scale: normalisation of the channels.
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
    first = image[..., :: image.shape[-1] // len(mean)]
    points, exists = _points(first, scale)
    turned = _turning(first[..., 4] * scale[4] + mean[4])
    height, width = image.shape[1:3]

    def padded(x: jax.Array) -> jax.Array:
        x = jnp.pad(x, ((0, 0), (0, 0), (COLUMNS, COLUMNS)), mode="wrap" if circular else "constant")
        return jnp.pad(x, ((0, 0), (ROWS, ROWS), (0, 0)))

    neighbours, neighbour_exists = [padded(x) for x in points], padded(exists)
    channels = []
    for row, column in window():
        cut = (slice(None), slice(row, row + height), slice(column, column + width))
        both = neighbour_exists[cut] * exists
        offsets = turned(*(other[cut] - own for other, own in zip(neighbours, points, strict=True)))
        channels += [*(offset * both for offset in offsets), both]
    return jnp.stack(channels, axis=-1)


def round_offsets(image: Image, *, mean: tuple[float, ...], scale: tuple[float, ...]) -> Image:
    """Compute the offsets from the first-round point of each pixel to its points of the later rounds.

    Args:
        image: the network's normalised input, with r rounds of each channel, ordered by type.
        mean, scale: normalisation of the channels.

    Returns:
        f[b, h, w, 5 (r - 1)]: for each later round the radial, tangential and vertical offset as in
        :func:`local_offsets`, the difference of the normalised times, and 1. All five are 0 if one of the points
        is missing.

    >>> nine = (0.0,) * 9, (1.0,) * 9
    >>> two = jnp.zeros((1, 1, 1, 9, 2)).at[..., 0, :].set(jnp.array([5.0, 5.2])).at[..., 7:, :].set(1.0)
    >>> offsets = round_offsets(two.reshape(1, 1, 1, 18), mean=nine[0], scale=nine[1])
    >>> (100 * offsets[0, 0, 0]).round().tolist()
    [88.0, 0.0, 0.0, 0.0, 100.0]
    """
    rounds = image.shape[-1] // len(mean)
    first = image[..., ::rounds]
    points, exists = _points(first, scale)
    turned, channels = _turning(first[..., 4] * scale[4] + mean[4]), []
    for r in range(1, rounds):
        later = image[..., r::rounds]
        others, filled = _points(later, scale)
        both = filled * exists
        offsets = turned(*(other - own for other, own in zip(others, points, strict=True)))
        channels += [*(x * both for x in (*offsets, later[..., 8] - first[..., 8])), both]
    return jnp.stack(channels, axis=-1) if channels else first[..., :0]


def _points(channels: Image, scale: tuple[float, ...]) -> tuple[list[jax.Array], jax.Array]:
    """Coordinates of points, still shifted by the means, which cancel in offsets; 1 where there is a point."""
    return [channels[..., i] * scale[i] for i in range(3)], (channels[..., 7] > 0).astype(channels.dtype)


def _turning(azimuth: jax.Array) -> Callable[..., tuple[jax.Array, ...]]:
    """Make a function that turns offsets to an azimuth and compresses them."""
    cos, sin = jnp.cos(azimuth), jnp.sin(azimuth)

    def turned(dx: jax.Array, dy: jax.Array, dz: jax.Array) -> tuple[jax.Array, ...]:
        return tuple(jnp.arcsinh(x / UNIT_M) for x in (cos * dx + sin * dy, cos * dy - sin * dx, dz))

    return turned


def own_numbers(image: Image, num_channels: int) -> Image:
    """Select height, range, inclination, intensity and existence of each pixel's first-round point.

    Channels that depend on the azimuth are left out: an object looks the same in every direction from the sensor.
    """
    return image[..., :: image.shape[-1] // num_channels][..., np.array(OWN)]


class LocalGeometry(nn.Module):
    """Two 1x1 convolutions, each with batch norm and ReLU, of :func:`local_offsets` and :func:`own_numbers`."""

    features: int
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    circular: bool = False
    later_rounds: bool = False  # Also use :func:`round_offsets`.

    @nn.compact
    def __call__(self, image: Image, *, train: bool) -> Image:
        offsets = local_offsets(image, mean=self.mean, scale=self.scale, circular=self.circular)
        parts = [offsets, own_numbers(image, len(self.mean))]
        if self.later_rounds:
            parts.append(round_offsets(image, mean=self.mean, scale=self.scale))
        x = jnp.concatenate(parts, axis=-1)
        for layer, width in enumerate((HIDDEN, self.features)):
            kernel = self.param(f"linear{layer}", kernel_init, (x.shape[-1], width))
            x = pointwise(x, kernel, precision=None if layer else FULL)
            (x,) = BatchNorm(name=f"norm{layer}")([x], train=train)
            x = jax.nn.relu(x)
        return x
