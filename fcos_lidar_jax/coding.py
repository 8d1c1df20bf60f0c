"""Boxes to regression numbers and back (paper, equation 2).

The ten numbers: centre minus point (3), log of l, w, h (3), sin and cos of the yaw relative to the point's
azimuth (2), velocity (2).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float32

from fcos_lidar_jax.geometry import atan2, wrap_angle

LOG_SIZE_LIMIT = 5.0  # Log sizes are clipped to plus and minus this: an untrained exponent must not overflow.


def encode(
    boxes: Float32[Array, "*l 9"], points: Float32[Array, "*l 3"], azimuth_rad: Float32[Array, "*l"]
) -> Float32[Array, "*l 10"]:
    """Regression targets of boxes as seen from points.

    Args:
        boxes: ``x, y, z, l, w, h, yaw, vx, vy``.
        points: the locations' 3D points, metres.
        azimuth_rad: their azimuth.

    >>> box = jnp.array([2, 0, 0, 1, 1, 1, 0.5, 3, 0], jnp.float32)
    >>> encode(box, jnp.array([1.0, 0, 0]), jnp.float32(0.5)).tolist()
    [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0, 0.0]
    """
    yaw = boxes[..., 6] - azimuth_rad
    return jnp.concatenate(
        [
            boxes[..., :3] - points,
            jnp.log(jnp.maximum(boxes[..., 3:6], jnp.exp(-LOG_SIZE_LIMIT))),
            jnp.sin(yaw)[..., None],
            jnp.cos(yaw)[..., None],
            boxes[..., 7:9],
        ],
        axis=-1,
    )


def _unit(sin: Array, cos: Array) -> tuple[Array, Array]:
    """Sine and cosine scaled to norm 1; (0, 1) for a vanishing pair. Gradients stay finite."""
    square = sin * sin + cos * cos
    regular = square > 1e-12
    norm = jnp.sqrt(jnp.where(regular, square, 1.0))
    return jnp.where(regular, sin / norm, 0.0), jnp.where(regular, cos / norm, 1.0)


def _size(regression: Array) -> Array:
    return jnp.exp(jnp.clip(regression[..., 3:6], -LOG_SIZE_LIMIT, LOG_SIZE_LIMIT))


def decode_oriented(
    regression: Float32[Array, "*l 10"], points: Float32[Array, "*l 3"], azimuth_rad: Float32[Array, "*l"]
) -> Float32[Array, "*l 8"]:
    """Predicted boxes as ``x, y, z, l, w, h, cos yaw, sin yaw``: differentiable, without an inverse tangent.

    >>> numbers = jnp.array([1, 0, 0, 0, 0, 0, 0, 2, 3, 0], jnp.float32)
    >>> decode_oriented(numbers, jnp.zeros(3), jnp.float32(0)).tolist()
    [1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0]
    """
    sin, cos = _unit(regression[..., 6], regression[..., 7])
    base_sin, base_cos = jnp.sin(azimuth_rad), jnp.cos(azimuth_rad)
    heading = jnp.stack([base_cos * cos - base_sin * sin, base_sin * cos + base_cos * sin], axis=-1)
    return jnp.concatenate([regression[..., :3] + points, _size(regression), heading], axis=-1)


def decode(
    regression: Float32[Array, "*l 10"], points: Float32[Array, "*l 3"], azimuth_rad: Float32[Array, "*l"]
) -> Float32[Array, "*l 9"]:
    """Predicted boxes ``x, y, z, l, w, h, yaw, vx, vy`` from the ten numbers; the inverse of :func:`encode`.

    >>> box = jnp.array([2, 0, 0, 1, 1, 1, 0.5, 3, 0], jnp.float32)
    >>> here, angle = jnp.array([1.0, 0, 0]), jnp.float32(0.25)
    >>> bool(jnp.allclose(decode(encode(box, here, angle), here, angle), box, atol=1e-6))
    True
    """
    yaw = wrap_angle(atan2(regression[..., 6], regression[..., 7]) + azimuth_rad)
    parts = [regression[..., :3] + points, _size(regression), yaw[..., None], regression[..., 8:10]]
    return jnp.concatenate(parts, axis=-1)
