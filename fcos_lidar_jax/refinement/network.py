"""The network of the second look: a PointNet on the points of each box."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float32, Int32

from fcos_lidar_jax.geometry import atan2, safe_norm
from fcos_lidar_jax.initialization import kernel_init
from fcos_lidar_jax.refinement.types import Crops

_FINE_M = 0.2  # Distance from the centre up to which asinh resolves positions finely.
_FULL = lax.Precision.HIGHEST  # Positions would be rounded to TF32 or bfloat16 otherwise.


def point_features(crops: Crops, boxes: Float32[Array, "m c"], limit_m: float = 25.0) -> Float32[Array, "m p 14"]:
    """Features of the points: position, distances to the six faces, intensity, fine position, time lag.

    A PointNet cannot see the size of the box in positions only, hence the distances to its faces (LiDAR R-CNN).
    Zero in slots without a point.
    """
    half = jnp.minimum(boxes[..., None, 3:6], limit_m) / 2
    place, intensity, lag = crops.points[..., :3], crops.points[..., 3:4], crops.points[..., 4:5]
    parts = [place, place + half, half - place, intensity / 255, jnp.arcsinh(place / _FINE_M), lag]
    return jnp.where(crops.valid[..., None], jnp.concatenate(parts, axis=-1), 0.0)


def box_features(
    boxes: Float32[Array, "m c"],
    scores: Float32[Array, "m"],
    labels: Int32[Array, "m"],
    count: Int32[Array, "m"],
    num_classes: int,
    *,
    with_velocity: bool = False,
) -> Float32[Array, "m f"]:
    """Features of the boxes: class, logit of the score, log sizes, range, number of points, turn from the ray.

    With ``with_velocity`` (static) also the velocity along the heading and to the left.
    """
    score = jnp.clip(scores, 1e-4, 1 - 1e-4)
    turn = boxes[..., 6] - atan2(boxes[..., 1], boxes[..., 0])
    columns = [
        jnp.log(score / (1 - score)),
        *(jnp.log(jnp.maximum(boxes[..., i], 0.05)) for i in (3, 4, 5)),
        safe_norm(boxes[..., 0], boxes[..., 1]) / 30,
        jnp.log1p(count) / 4,
        jnp.sin(turn),
        jnp.cos(turn),
    ]
    if with_velocity:
        cos, sin, vx, vy = jnp.cos(boxes[..., 6]), jnp.sin(boxes[..., 6]), boxes[..., 7], boxes[..., 8]
        columns += [(cos * vx + sin * vy) / 10, (cos * vy - sin * vx) / 10]
    return jnp.concatenate([jax.nn.one_hot(labels, num_classes), jnp.stack(columns, axis=-1)], axis=-1)


class SecondLook(nn.Module):
    """Layers on each point, the maximum over the points of a box, and layers on each box.

    Returns class logits [..., k + 1], with the background last, and residuals [..., r].
    """

    num_classes: int
    residual_size: int  # Numbers of a residual, see ``targets.encode_residual``.
    point_channels: tuple[int, ...]
    box_channels: tuple[int, ...]

    @nn.compact
    def __call__(
        self, inputs: tuple[Array, Array, Array], *, train: bool = False
    ) -> tuple[Float32[Array, "*b k"], Float32[Array, "*b r"]]:
        x, valid, boxes = inputs
        for layer, width in enumerate(self.point_channels):
            x = nn.Dense(width, kernel_init=_he, precision=_FULL, name=f"point{layer}")(x)
            x = jax.nn.relu(nn.LayerNorm(epsilon=1e-5, name=f"norm{layer}")(x))
        # ReLU makes zero the maximum over no points.
        x = jnp.concatenate([jnp.where(valid[..., None], x, 0.0).max(axis=-2), boxes], axis=-1)
        for layer, width in enumerate(self.box_channels):
            x = jax.nn.relu(nn.Dense(width, kernel_init=_he, name=f"box{layer}")(x))
        x = nn.Dense(self.num_classes + 1 + self.residual_size, kernel_init=_small, name="out")(x)
        logits, residual = jnp.split(x, [self.num_classes + 1], axis=-1)
        return logits, residual.at[..., -1].add(1.0)  # Zero outputs leave a box as it is.


def _he(key: Array, shape: tuple[int, ...], dtype: object = None) -> Array:
    return kernel_init(key, shape) * np.sqrt(shape[1] / shape[0], dtype=np.float32)  # over the inputs


def _small(key: Array, shape: tuple[int, ...], dtype: object = None) -> Array:
    return 0.1 * _he(key, shape)
