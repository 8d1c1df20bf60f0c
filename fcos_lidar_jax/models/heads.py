"""Detection heads: two towers per level and class-specific predictions (paper, section 3.4)."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array

from fcos_lidar_jax.initialization import normal
from fcos_lidar_jax.models.convolution import Image, convolve
from fcos_lidar_jax.models.layers import Conv, GroupNorm, at_least_float32, pieces
from fcos_lidar_jax.types import Outputs

_REGRESSION = {"centre": 3, "size": 3, "heading": 2, "velocity": 2}  # Numbers per class of the sibling layers.
_CHANNEL_MULTIPLE = 32
"""The channels of fused predictions are padded to a multiple of this: on a CPU, 110 run at half the speed of
128."""


class Tower(nn.Module):
    """3x3 convolutions, each with group norm and ReLU."""

    channels: int
    depth: int
    circular: bool = False

    @nn.compact
    def __call__(self, x: Image) -> Image:
        for i in range(self.depth):
            x = Conv(self.channels, circular=self.circular, name=f"conv{i}")(x)
            x = jax.nn.relu(GroupNorm(name=f"norm{i}")(x))
        return x


class Predictions(nn.Module):
    """Sibling 3x3 prediction layers in one convolution."""

    sizes: dict[str, int]
    biases: dict[str, tuple[float, ...]]
    circular: bool = False

    @nn.compact
    def __call__(self, x: Image) -> dict[str, Image]:
        x = at_least_float32(x)
        kernels, biases = [], []
        for name, size in self.sizes.items():
            shape = (3, 3, x.shape[-1], size)
            kernels.append(self.param(f"{name}_kernel", normal, shape, 0.01))
            start = jnp.asarray(self.biases.get(name, (0.0,) * size), jnp.float32)
            biases.append(self.param(f"{name}_bias", lambda _, start=start: start))
        total = sum(self.sizes.values())
        kernel = jnp.concatenate(kernels, axis=-1)
        kernel = jnp.pad(kernel, [(0, 0)] * 3 + [(0, -total % _CHANNEL_MULTIPLE)])
        # Rounding to TF32 on GPUs moves a centre by a millimetre only, since it is relative to its point.
        y = convolve(x, kernel, circular=self.circular)[..., :total] + jnp.concatenate(biases)
        cuts = pieces(list(self.sizes.values()))
        return {name: y[..., cut] for name, cut in zip(self.sizes, cuts, strict=True)}


class Head(nn.Module):
    """Classification and regression of one level."""

    num_classes: int
    channels: int
    depth: int
    background_prior: float
    circular: bool = False

    @nn.compact
    def __call__(self, x: Image, local: Image | None = None) -> Outputs:
        """Predict at all locations of the level, flattened.

        Local features, if given, are added before the towers and again after them, directly before the
        predictions."""
        k = self.num_classes
        if local is not None:
            local = local.astype(x.dtype)
            x = x + local
        # With zero class logits, this makes P(background) equal to the prior.
        prior = math.log(k * self.background_prior / (1 - self.background_prior))
        classes = Tower(self.channels, self.depth, self.circular, name="classification_tower")(x)
        boxes = Tower(self.channels, self.depth, self.circular, name="regression_tower")(x)
        if local is not None:
            classes = self._joined(classes, local, "classification_local")
            boxes = self._joined(boxes, local, "regression_local")
        biases = {"logits": (0.0,) * k + (prior,)}
        logits = Predictions({"logits": k + 1}, biases, self.circular, name="classification")(classes)["logits"]
        sizes = {**{name: count * k for name, count in _REGRESSION.items()}, "iou": k}
        numbers = Predictions(sizes, {}, self.circular, name="regression")(boxes)

        def flat(y: Array, *shape: int) -> Array:
            return y.reshape(y.shape[0], -1, *shape)

        regression = [flat(numbers[name], count, k) for name, count in _REGRESSION.items()]
        return Outputs(flat(logits, k + 1), jnp.concatenate(regression, axis=2), flat(numbers["iou"], k))

    def _joined(self, x: Image, local: Image, name: str) -> Image:
        return jax.nn.relu(x + Conv(self.channels, 1, name=name)(local))


class Heads(nn.Module):
    """One head per level, or one head for all levels (table 6)."""

    num_classes: int
    channels: int
    depth: int
    background_prior: float
    tied: bool = False
    circular: bool = False

    @nn.compact
    def __call__(self, levels: list[Image], local: list[Image] | None = None) -> Outputs:
        """Predict at the locations of all levels, from P2 to P7, with optional local features per level."""
        options = self.num_classes, self.channels, self.depth, self.background_prior, self.circular
        shared = Head(*options, name="shared") if self.tied else None
        pairs = zip(levels, local or [None] * len(levels), strict=True)
        outputs = [(shared or Head(*options, name=f"level{i + 2}"))(*pair) for i, pair in enumerate(pairs)]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *outputs)
