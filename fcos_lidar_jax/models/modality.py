"""Modality-wise convolutions (paper, section 3.3, tables 3-5)."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.models.layers import BatchNorm, Image, Kernel, convolve, kernel_init, pieces

_MODALITIES = (3, 3, 1, 1, 1)
"""Channel types a modality: (x, y, z), (range, azimuth, inclination), intensity, existence, time lag."""


def channel_groups(config: StemConfig, num_rounds: int) -> list[tuple[int, int]]:
    """(input channels, output channels) of each group; the input's channels of one type are adjacent.

    >>> channel_groups(StemConfig(groups="modalities"), 5)
    [(15, 96), (15, 96), (5, 32), (5, 32), (5, 32)]
    """
    width = config.channels_per_type
    if not config.group_rounds:
        return [(1, width // num_rounds)] * (9 * num_rounds)
    types = {"types": (1,) * 9, "modalities": _MODALITIES, "all": (9,)}[config.groups]
    return [(count * num_rounds, count * width) for count in types]


def modality_convolve(
    parts: Sequence[Image], kernels: Sequence[Kernel], *, dilation: int, circular: bool, form: str
) -> list[Image]:
    """One 3x3 convolution for each group of channels.

    Args:
        parts: the groups' channels.
        kernels: one a group.
        dilation: of both axes (static).
        circular: wrap the width (static).
        form: ``"split"``, one convolution a group, or ``"grouped"``, a single grouped convolution, far slower
            on CPU (static). Groups of different sizes are always split.

    >>> parts, kernels = [jnp.ones((1, 4, 4, 2))] * 3, [jnp.ones((3, 3, 2, 5))] * 3
    >>> len(modality_convolve(parts, kernels, dilation=1, circular=False, form="split"))
    3
    """
    if form == "split" or len({k.shape for k in kernels}) > 1:
        return [convolve(x, k, dilation=dilation, circular=circular) for x, k in zip(parts, kernels, strict=True)]
    x, kernel = jnp.concatenate(parts, axis=-1), jnp.concatenate(kernels, axis=-1)
    y = convolve(x, kernel, dilation=dilation, groups=len(parts), circular=circular)
    return [y[..., cut] for cut in pieces([k.shape[-1] for k in kernels])]


class ModalityBranch(nn.Module):
    """The grouped convolutions of one dilation rate, each with batch norm and ReLU."""

    config: StemConfig
    widths: tuple[int, ...]
    dilation: int
    circular: bool = False
    precision: str = "float32"

    @nn.compact
    def __call__(self, parts: Sequence[Image], *, train: bool) -> list[Image]:
        """Features of every group, ``widths`` channels each."""
        for layer in range(self.config.num_convs):
            kernels = [
                self.param(f"conv{layer}_group{g}", kernel_init, (3, 3, x.shape[-1], size))
                for g, (x, size) in enumerate(zip(parts, self.widths, strict=True))
            ]
            parts = modality_convolve(
                parts, kernels, dilation=self.dilation, circular=self.circular, form=self.config.form
            )
            parts = [jax.nn.relu(x) for x in BatchNorm(name=f"norm{layer}")(parts, train=train)]
            if self.precision == "bfloat16":  # only behind the first layer: metres need more bits
                parts = [x.astype(jnp.bfloat16) for x in parts]
        return list(parts)


class Stem(nn.Module):
    """Parallel modality-wise branches, merged by 1x1 convolutions and summed."""

    config: StemConfig
    circular: bool = False
    precision: str = "float32"

    @nn.compact
    def __call__(self, image: Image, *, train: bool) -> Image:
        """Features of the merged modalities.

        Args:
            image: normalised, ``9 r`` channels, those of one type adjacent.
            train: normalise by the batch's statistics.
        """
        config = self.config
        num_rounds = image.shape[-1] // 9
        groups = channel_groups(config, num_rounds)
        parts = [image[..., cut] for cut in pieces([size for size, _ in groups])]
        widths = tuple(out for _, out in groups)
        merged = jnp.zeros((), image.dtype)  # the sum over all groups keeps the image's precision
        computed = image.dtype
        shape = (sum(widths), config.out_channels)
        num_kernels = len(config.dilations) if config.merge == "per_branch" else 1
        kernels = [self.param(f"merge{i}", nn.initializers.he_normal(), shape) for i in range(num_kernels)]
        for index, dilation in enumerate(config.dilations):
            branch = ModalityBranch(config, widths, dilation, self.circular, self.precision, name=f"branch{index}")
            features = branch(parts, train=train)
            computed = features[0].dtype
            # Accumulated group by group: no concatenation of all features is ever written.
            for feature, rows in zip(features, pieces(widths), strict=True):
                kernel = kernels[index % num_kernels][rows].astype(feature.dtype)
                merged = merged + jnp.einsum("bhwc,co->bhwo", feature, kernel, preferred_element_type=image.dtype)
        (merged,) = BatchNorm(name="norm")([merged], train=train)
        return jax.nn.relu(merged).astype(computed)
