"""Encode boxes as regression values and decode them (paper, equation 2).

The ten values are centre minus point (3), log of l, w, h (3), sin and cos of the yaw relative to the point's
azimuth (2), and velocity (2).

The centre offset and the velocity contain horizontal vectors. The paper gives both along the axes of the LiDAR
frame, ``axes="lidar"``. With ``axes="ray"`` the first axis points along the point's azimuth, as in LaserNet (Meyer
et al., CVPR 2019) and RangeDet (Fan et al., ICCV 2021). Moving a vehicle around the sensor then changes neither
its ten values nor its appearance in the range image.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float32

from fcos_lidar_jax.geometry import atan2, wrap_angle
from fcos_lidar_jax.types import check_columns

Axes = Literal["lidar", "ray"]

_VALUES = "dx, dy, dz, log l, log w, log h, sin, cos, vx, vy"

LOG_SIZE_LIMIT = 5.0  # Log sizes are clipped to +-LOG_SIZE_LIMIT so that exp of an untrained output is finite.


def _turn(vectors: Array, sin: Array, cos: Array) -> Array:
    """Rotate horizontal vectors ``[..., 2]`` counter-clockwise."""
    x, y = vectors[..., 0], vectors[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def encode(
    boxes: Float32[Array, "*l 9"],
    points: Float32[Array, "*l 3"],
    azimuth_rad: Float32[Array, "*l"],
    *,
    axes: Axes = "lidar",
) -> Float32[Array, "*l 10"]:
    """Regression targets of boxes relative to points.

    Args:
        boxes: ``x, y, z, l, w, h, yaw, vx, vy``.
        points: 3D points of the locations, metres.
        azimuth_rad: azimuth of the points.
        axes: axes of the centre offset and the velocity, see the module docstring (static).

    >>> box = jnp.array([2, 0, 0, 1, 1, 1, 0.5, 3, 0], jnp.float32)
    >>> encode(box, jnp.array([1.0, 0, 0]), jnp.float32(0.5)).tolist()
    [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0, 0.0]
    """
    check_columns("boxes", boxes, "x, y, z, l, w, h, yaw, vx, vy")
    yaw = boxes[..., 6] - azimuth_rad
    offset, velocity = boxes[..., :2] - points[..., :2], boxes[..., 7:9]
    if axes == "ray":
        clockwise = -jnp.sin(azimuth_rad), jnp.cos(azimuth_rad)
        known = ~jnp.isnan(velocity).any(axis=-1, keepdims=True)
        turned = _turn(jnp.where(known, velocity, 0.0), *clockwise)  # unknown velocities have no gradient
        offset, velocity = _turn(offset, *clockwise), jnp.where(known, turned, jnp.nan)
    return jnp.concatenate(
        [
            offset,
            boxes[..., 2:3] - points[..., 2:],
            jnp.log(jnp.maximum(boxes[..., 3:6], jnp.exp(-LOG_SIZE_LIMIT))),
            jnp.sin(yaw)[..., None],
            jnp.cos(yaw)[..., None],
            velocity,
        ],
        axis=-1,
    )


def _unit(sin: Array, cos: Array) -> tuple[Array, Array]:
    """Scale sine and cosine to norm 1, or return (0, 1) for a zero pair. Gradients are finite."""
    square = sin * sin + cos * cos
    regular = square > 1e-12
    norm = jnp.sqrt(jnp.where(regular, square, 1.0))
    return jnp.where(regular, sin / norm, 0.0), jnp.where(regular, cos / norm, 1.0)


def _size(regression: Array) -> Array:
    return jnp.exp(jnp.clip(regression[..., 3:6], -LOG_SIZE_LIMIT, LOG_SIZE_LIMIT))


def _centre(regression: Array, points: Array, sin: Array, cos: Array, axes: Axes) -> Array:
    offset = _turn(regression[..., :2], sin, cos) if axes == "ray" else regression[..., :2]
    return jnp.concatenate([offset, regression[..., 2:3]], axis=-1) + points


def decode_oriented(
    regression: Float32[Array, "*l 10"],
    points: Float32[Array, "*l 3"],
    azimuth_rad: Float32[Array, "*l"],
    *,
    axes: Axes = "lidar",
) -> Float32[Array, "*l 8"]:
    """Decode boxes to ``x, y, z, l, w, h, cos yaw, sin yaw``, differentiably and without an arctangent.

    >>> numbers = jnp.array([1, 0, 0, 0, 0, 0, 0, 2, 3, 0], jnp.float32)
    >>> decode_oriented(numbers, jnp.zeros(3), jnp.float32(0)).tolist()
    [1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0]
    """
    check_columns("regression", regression, _VALUES)
    sin, cos = _unit(regression[..., 6], regression[..., 7])
    base_sin, base_cos = jnp.sin(azimuth_rad), jnp.cos(azimuth_rad)
    heading = jnp.stack([base_cos * cos - base_sin * sin, base_sin * cos + base_cos * sin], axis=-1)
    centre = _centre(regression, points, base_sin, base_cos, axes)
    return jnp.concatenate([centre, _size(regression), heading], axis=-1)


def decode(
    regression: Float32[Array, "*l 10"],
    points: Float32[Array, "*l 3"],
    azimuth_rad: Float32[Array, "*l"],
    *,
    axes: Axes = "lidar",
) -> Float32[Array, "*l 9"]:
    """Decode the ten values to boxes ``x, y, z, l, w, h, yaw, vx, vy``; the inverse of :func:`encode`.

    >>> box = jnp.array([2, 0, 0, 1, 1, 1, 0.5, 3, 0], jnp.float32)
    >>> here, angle = jnp.array([1.0, 0, 0]), jnp.float32(0.25)
    >>> bool(jnp.allclose(decode(encode(box, here, angle), here, angle), box, atol=1e-6))
    True
    """
    check_columns("regression", regression, _VALUES)
    yaw = wrap_angle(atan2(regression[..., 6], regression[..., 7]) + azimuth_rad)
    ray = jnp.sin(azimuth_rad), jnp.cos(azimuth_rad)
    velocity = _turn(regression[..., 8:10], *ray) if axes == "ray" else regression[..., 8:10]
    parts = [_centre(regression, points, *ray, axes), _size(regression), yaw[..., None], velocity]
    return jnp.concatenate(parts, axis=-1)
