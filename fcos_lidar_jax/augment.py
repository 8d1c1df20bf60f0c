"""Augmentation on the device: points, boxes and velocities together (paper, section 4)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Int, PRNGKeyArray, UInt32

from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.sensors import Sensor

Key = PRNGKeyArray | UInt32[Array, "2"]
Cloud = Float32[Array, "n c"]
Truth = Float32[Array, "m 9"]


def check_augmentation(config: AugmentConfig, sensor: Sensor) -> None:
    """Reject augmentation that moves most points out of a sensor's sector. A full turn allows any augmentation.

    Raises:
        ValueError: a rotation by more than half of the sector, or a flip that does not map the sector onto itself.

    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E, sector
    >>> check_augmentation(AugmentConfig(), sector(NUSCENES_HDL32E, 0.0, 272))
    Traceback (most recent call last):
    ValueError: ...
    """
    if sensor.azimuth_limits_rad is None or sensor.num_columns * sensor.column_rad > 2 * np.pi - sensor.column_rad:
        return
    right, left = sensor.azimuth_limits_rad
    where = f"sensor {sensor.name!r} covers {np.degrees(left - right):.0f} degrees"
    half = (left - right) / 2
    angle, expected = config.max_rotation_rad, f"at most {half:.3g}, half of the sector: {where}"
    check(angle <= half, "augment.max_rotation_rad", angle, expected)
    # A flip of x maps azimuth a to pi - a, a flip of y maps it to -a.
    for name, turn in (("flip_x_probability", np.pi), ("flip_y_probability", 0.0)):
        offset = (right + left - turn + np.pi) % (2 * np.pi) - np.pi
        probability, expected = getattr(config, name), f"0: {where}, and the flip does not map it onto itself"
        check(probability == 0 or abs(offset) <= 2 * sensor.column_rad, f"augment.{name}", probability, expected)


def flip_x(points: Cloud, boxes: Truth) -> tuple[Cloud, Truth]:
    """Mirror x: yaw becomes pi - yaw, vx changes sign.

    >>> flip_x(jnp.ones((1, 5)), jnp.zeros((1, 9)))[0][0].tolist()
    [-1.0, 1.0, 1.0, 1.0, 1.0]
    """
    signs = jnp.array([-1, 1, 1, 1, 1, 1, 1, -1, 1], jnp.float32)
    boxes = (boxes * signs).at[:, 6].set(wrap_angle(np.pi - boxes[:, 6]))
    return points.at[:, 0].multiply(-1.0), boxes


def flip_y(points: Cloud, boxes: Truth) -> tuple[Cloud, Truth]:
    """Mirror y: yaw and vy change sign.

    >>> flip_y(jnp.ones((1, 5)), jnp.zeros((1, 9)))[0][0].tolist()
    [1.0, -1.0, 1.0, 1.0, 1.0]
    """
    signs = jnp.array([1, -1, 1, 1, 1, 1, 1, 1, -1], jnp.float32)
    boxes = (boxes * signs).at[:, 6].set(wrap_angle(-boxes[:, 6]))
    return points.at[:, 1].multiply(-1.0), boxes


def rotate(points: Cloud, boxes: Truth, angle_rad: Float32[Array, ""]) -> tuple[Cloud, Truth]:
    """Rotate counter-clockwise about z.

    >>> rotate(jnp.ones((1, 5)), jnp.zeros((1, 9)), jnp.float32(np.pi / 2))[0][0, :2].round(3).tolist()
    [-1.0, 1.0]
    """
    cos, sin = jnp.cos(angle_rad), jnp.sin(angle_rad)

    def turn(values: Array, first: int) -> Array:
        x, y = values[:, first], values[:, first + 1]
        return values.at[:, first].set(cos * x - sin * y).at[:, first + 1].set(sin * x + cos * y)

    boxes = turn(turn(boxes, 0), 7)
    return turn(points, 0), boxes.at[:, 6].set(wrap_angle(boxes[:, 6] + angle_rad))


def scale(points: Cloud, boxes: Truth, factor: Float32[Array, ""]) -> tuple[Cloud, Truth]:
    """Scale positions, sizes and velocities.

    >>> scale(jnp.ones((1, 5)), jnp.zeros((1, 9)), jnp.float32(2))[0][0].tolist()
    [2.0, 2.0, 2.0, 1.0, 1.0]
    """
    factors = jnp.where(jnp.arange(9) == 6, 1.0, factor)
    return points.at[:, :3].multiply(factor), boxes * factors


def augment(
    key: Key,
    points: Cloud,
    boxes: Truth,
    config: AugmentConfig,
    *,
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Cloud, Truth]:
    """Flip, rotate and scale one sample at random, about the sensor.

    Global translation is omitted because it would break the range view. The projection applies the range limits
    afterwards.

    Args:
        key: the sample's key, see :func:`sample_key`.
        points: x, y, z, ... in metres; the other columns are unchanged.
        boxes: ``x, y, z, l, w, h, yaw, vx, vy``; NaN velocities stay NaN.
        origin_m: position of the sensor, which stays fixed.

    >>> still = AugmentConfig(0.0, 0.0, 0.0, (1.0, 1.0))
    >>> cloud, truth = jnp.ones((2, 5)), jnp.ones((1, 9))
    >>> bool((augment(jax.random.key(0), cloud, truth, still)[0] == cloud).all())
    True
    """
    with jax.named_scope("augment"):
        keys = jax.random.split(key, 4)
        origin = jnp.array(origin_m, jnp.float32)
        points, boxes = points.at[:, :3].add(-origin), boxes.at[:, :3].add(-origin)
        for flip, flip_key, probability in (
            (flip_x, keys[0], config.flip_x_probability),
            (flip_y, keys[1], config.flip_y_probability),
        ):
            apply = jax.random.bernoulli(flip_key, float(probability))
            flipped = flip(points, boxes)
            points, boxes = (jnp.where(apply, a, b) for a, b in zip(flipped, (points, boxes), strict=True))
        limit = config.max_rotation_rad
        points, boxes = rotate(points, boxes, jax.random.uniform(keys[2], (), jnp.float32, -limit, limit))
        points, boxes = scale(points, boxes, jax.random.uniform(keys[3], (), jnp.float32, *config.scale_range))
        return points.at[:, :3].add(origin), boxes.at[:, :3].add(origin)


def sample_key(key: Key, step: Int[Array, ""], index: Int[Array, ""]) -> Key:
    """Key of one sample of one step, from its index in the *global* batch, so independent of the devices.

    >>> a, b = (sample_key(jax.random.key(0), jnp.int32(3), jnp.int32(i)) for i in (0, 1))
    >>> bool((jax.random.key_data(a) == jax.random.key_data(b)).all())
    False
    """
    return jax.random.fold_in(jax.random.fold_in(key, step), index)
