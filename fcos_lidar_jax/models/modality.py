"""Modality-wise convolutions (paper, section 3.3, tables 3-5)."""

import itertools
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax

from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.initialization import kernel_init
from fcos_lidar_jax.models.convolution import FULL, Image, Kernel, convolve, pointwise
from fcos_lidar_jax.models.layers import BatchNorm, pieces
from fcos_lidar_jax.types import CHANNELS

_VECTORS = (3, 3)
"""Channel types of the first modalities, (x, y, z) and (range, azimuth, inclination). The others have one each."""
_WIDE = 24
"""Output channels below which separate convolutions cost more than one block-diagonal convolution."""


def channel_groups(config: StemConfig, num_rounds: int, number: int = len(CHANNELS)) -> list[tuple[int, int]]:
    """List (input channels, output channels) of each group of the first convolution, for ``number`` channel types.

    >>> channel_groups(StemConfig(groups="modalities"), 5)
    [(15, 96), (15, 96), (5, 32), (5, 32), (5, 32)]
    """
    width = config.channels_per_type
    if not config.group_rounds:
        return [(1, width // num_rounds)] * (number * num_rounds)
    modalities = *_VECTORS, *(1,) * (number - sum(_VECTORS))
    types = {"types": (1,) * number, "modalities": modalities, "all": (number,)}[config.groups]
    return [(count * num_rounds, count * width) for count in types]


def bundles(groups: Sequence[tuple[int, int]]) -> list[slice]:
    """Assign groups to convolutions: as many convolutions as possible that have enough output channels.

    >>> bundles([(5, 8)] * 9)
    [slice(0, 3, None), slice(3, 6, None), slice(6, 9, None)]
    >>> bundles([(5, 4)] * 9)
    [slice(0, 9, None)]
    """
    cuts, width = [0], 0
    for end, (_, outputs) in enumerate(groups, 1):
        width += outputs
        if width >= _WIDE:
            cuts.append(end)
            width = 0
    # Remaining narrow groups join the last bundle.
    return [slice(*ends) for ends in itertools.pairwise([*cuts[: max(1, len(cuts) - 1)], len(groups)])]


def block_diagonal(kernels: Sequence[Kernel]) -> Kernel:
    """Combine the kernels of several groups into one kernel without connections between groups.

    >>> block_diagonal([jnp.ones((3, 3, 1, 2)), jnp.ones((3, 3, 2, 4))])[0, 0].sum(axis=1).tolist()
    [2.0, 4.0, 4.0]
    """
    columns = pieces([kernel.shape[-1] for kernel in kernels])
    total = columns[-1].stop
    rows = [
        jnp.pad(kernel, [(0, 0)] * 3 + [(cut.start, total - cut.stop)])
        for kernel, cut in zip(kernels, columns, strict=True)
    ]
    return jnp.concatenate(rows, axis=2)


class ModalityBranch(nn.Module):
    """Grouped convolutions with one dilation, each with batch norm and ReLU."""

    config: StemConfig
    groups: tuple[tuple[int, int], ...]
    dilation: int
    circular: bool = False
    precision: str = "float32"

    @nn.compact
    def __call__(self, parts: Sequence[Image], *, train: bool) -> list[Image]:
        cuts = bundles(self.groups)
        sizes, widths = zip(*self.groups, strict=True)
        for layer in range(self.config.num_convs):
            kernels = [
                self.param(f"conv{layer}_group{g}", kernel_init, (3, 3, size, width))
                for g, (size, width) in enumerate(zip(sizes, widths, strict=True))
            ]
            precision = None if layer else FULL
            parts = [self._convolve(x, kernels[cut], precision) for x, cut in zip(parts, cuts, strict=True)]
            parts = [jax.nn.relu(x) for x in BatchNorm(name=f"norm{layer}")(parts, train=train)]
            if self.precision == "bfloat16":  # Only after the first layer, since positions need more bits.
                parts = [x.astype(jnp.bfloat16) for x in parts]
            sizes = widths
        return list(parts)

    def _convolve(self, x: Image, kernels: Sequence[Kernel], precision: lax.Precision | None) -> Image:
        options = {"dilation": self.dilation, "circular": self.circular, "precision": precision}
        return convolve(x, block_diagonal(kernels), **options)


class Stem(nn.Module):
    """Parallel modality-wise branches, merged by 1x1 convolutions and summed.

    The input is a normalised image with ``number r`` channels, ordered by type.

    Groups have independent convolutions, of which narrow ones are joined by block-diagonal kernels.
    ``feature_group_count`` is slow on CPUs, and if a batch is split over devices XLA gathers its images on each of
    them.
    """

    config: StemConfig
    circular: bool = False
    precision: str = "float32"
    number: int = len(CHANNELS)  # Channel types.

    @nn.compact
    def __call__(self, image: Image, *, train: bool) -> Image:
        config = self.config
        groups = channel_groups(config, image.shape[-1] // self.number, self.number)
        sizes = [sum(size for size, _ in groups[cut]) for cut in bundles(groups)]
        parts = [image[..., cut] for cut in pieces(sizes)]
        merged = jnp.zeros((), image.dtype)  # The sum over all groups has the image's precision.
        computed = image.dtype
        shape = (sum(width for _, width in groups), config.out_channels)
        num_kernels = len(config.dilations) if config.merge == "per_branch" else 1
        kernels = [self.param(f"merge{i}", nn.initializers.he_normal(), shape) for i in range(num_kernels)]
        for index, dilation in enumerate(config.dilations):
            if index:
                # Compute branches one after the other, since their features together need more GPU memory.
                parts, merged = lax.platform_dependent(
                    (parts, merged), cpu=lambda both: both, default=lax.optimization_barrier
                )
            options = dilation, self.circular, self.precision
            branch = ModalityBranch(config, tuple(groups), *options, name=f"branch{index}")
            features = branch(parts, train=train)
            computed = features[0].dtype
            # Accumulated group by group, which avoids writing a concatenation of all features.
            for feature, rows in zip(features, pieces([f.shape[-1] for f in features]), strict=True):
                kernel = kernels[index % num_kernels][rows]
                merged = merged + pointwise(feature, kernel, dtype=image.dtype)
        (merged,) = BatchNorm(name="norm")([merged], train=train)
        return jax.nn.relu(merged).astype(computed)
