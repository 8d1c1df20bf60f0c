"""Feature pyramid, P2 to P7 (paper, section 3.4)."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from fcos_lidar_jax.models.layers import Conv, Image


def double(x: Image) -> Image:
    """Upsample by two with nearest neighbours."""
    b, h, w, c = x.shape
    return jnp.broadcast_to(x[:, :, None, :, None], (b, h, 2, w, 2, c)).reshape(b, 2 * h, 2 * w, c)


class FeaturePyramid(nn.Module):
    """1x1 laterals, top-down sums and 3x3 outputs; P6 and P7 from P5 and ReLU(P6) at stride 2."""

    channels: int
    circular: bool = False

    @nn.compact
    def __call__(self, levels: list[Image]) -> list[Image]:
        laterals = [Conv(self.channels, 1, use_bias=True, name=f"lateral{i + 2}")(c) for i, c in enumerate(levels)]
        for i in range(len(laterals) - 2, -1, -1):
            laterals[i] = laterals[i] + double(laterals[i + 1])

        def spatial(x: Image, name: str, stride: int = 1) -> Image:
            return Conv(self.channels, 3, stride, use_bias=True, circular=self.circular, name=name)(x)

        outputs = [spatial(x, f"output{i + 2}") for i, x in enumerate(laterals)]
        outputs.append(spatial(outputs[-1], "output6", 2))
        outputs.append(spatial(jax.nn.relu(outputs[-1]), "output7", 2))
        return outputs
