"""A network of one layer in the place of FCOS-LiDAR's, for tests of what surrounds the network.

A training step is traced and compiled in a third of the time. Range images, losses, candidates and NMS stay.
"""

import contextlib
import math
from collections.abc import Iterator

import flax.linen as nn
import jax.numpy as jnp

from fcos_lidar_jax.config import ModelConfig
from fcos_lidar_jax.locations import STRIDES
from fcos_lidar_jax.models import detector
from fcos_lidar_jax.models.layers import BatchNorm
from fcos_lidar_jax.types import Outputs


class LinearNetwork(nn.Module):
    """Normalises the image and maps each location's pixel linearly to its predictions, mostly background."""

    config: ModelConfig
    num_classes: int

    @nn.compact
    def __call__(self, image, *, train: bool) -> Outputs:
        k = self.num_classes
        (image,) = BatchNorm(name="norm")([image], train=train)
        numbers = nn.Dense(12 * k + 1, name="predictions")(image)
        levels = [numbers[:, ::stride, ::stride].reshape(len(image), -1, 12 * k + 1) for stride in STRIDES]
        logits, regression, iou = jnp.split(jnp.concatenate(levels, axis=1), (k + 1, 11 * k + 1), axis=2)
        prior = math.log(k * self.config.background_prior / (1 - self.config.background_prior))
        logits += jnp.pad(jnp.full(1, prior, logits.dtype), (k, 0))
        return Outputs(logits, regression.reshape(*regression.shape[:2], 10, k), iou)


def use(network: type[nn.Module] = LinearNetwork) -> None:
    """Let all detectors that are built from now on in this process have this network."""
    detector.Network = network
    detector.build_detector.cache_clear()


@contextlib.contextmanager
def linear_network() -> Iterator[None]:
    """Detectors that are built meanwhile have the linear network."""
    given = detector.Network
    use()
    try:
        yield
    finally:
        use(given)
