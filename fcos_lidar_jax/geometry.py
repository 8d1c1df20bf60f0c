"""Angles, rotations and points in boxes, with finite values and gradients also at the origin."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int32

from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import BOX, check_columns

# Coefficients of atan(t) / t in t^2 on [0, 1]: minimax in the relative error, 1.2e-9 in exact arithmetic.
_ATAN = (
    0.999999998794722,
    -0.3333327494244605,
    0.1999679322591366,
    -0.1423171745399175,
    0.10729761907310403,
    -0.07653839393789628,
    0.044059961216975786,
    -0.016704039013780557,
    0.0029650098912646344,
)


def safe_norm(*components: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Euclidean norm of the vector of arguments, with zero gradient (not NaN) at zero.

    >>> float(safe_norm(jnp.float32(3), jnp.float32(4)))
    5.0
    """
    square = sum((c * c for c in components[1:]), components[0] * components[0])
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def atan2(y: Float[Array, "*n"], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Angle of (x, y) in [-pi, pi], within 3e-7 of the exact angle in float32.

    Evaluates a polynomial with additions and multiplications only, which vectorises where the library call does
    not and has a finite gradient at the origin. Signed zeros follow the C convention.

    >>> round(float(atan2(jnp.float32(1), jnp.float32(-1))), 4)
    2.3562
    """
    ax, ay = jnp.abs(x), jnp.abs(y)
    high = jnp.maximum(ax, ay)
    t = jnp.minimum(ax, ay) / jnp.where(high > 0, high, 1.0)
    square = t * t
    series = jnp.full_like(t, _ATAN[-1])
    for coefficient in _ATAN[-2::-1]:
        series = series * square + coefficient
    angle = series * t
    angle = jnp.where(ay > ax, np.pi / 2 - angle, angle)
    angle = jnp.where(jnp.signbit(x), np.pi - angle, angle)
    return jnp.where(jnp.signbit(y), -angle, angle)


def spherical(xyz: Float[Array, "*n 3"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Range, azimuth in [-pi, pi] and inclination in [-pi/2, pi/2] of points (paper, equation 1).

    All three are zero at the origin.

    >>> [round(float(v), 4) for v in spherical(jnp.array([0.0, 2.0, 0.0]))]
    [2.0, 1.5708, 0.0]
    """
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    return safe_norm(x, y, z), atan2(y, x), atan2(z, safe_norm(x, y))


def image_columns(azimuth: Float[Array, "n"], sensor: Sensor) -> tuple[Int32[Array, "n"], Bool[Array, "n"]]:
    """Image column of each azimuth, clockwise from the sensor's first azimuth, and whether the sensor covers it.

    The sensor is static.

    >>> from fcos_lidar_jax.sensors import TINY, sector
    >>> column, inside = image_columns(jnp.array([0.0, 3.0]), sector(TINY, 0.0, 2))
    >>> column[:1].tolist(), inside.tolist()
    ([1], [True, False])
    """
    clockwise = np.float32(sensor.first_azimuth_rad) - azimuth
    if not sensor.is_full_turn:
        clockwise = jnp.mod(clockwise, np.float32(2 * np.pi))
    column = jnp.floor(clockwise * np.float32(1 / sensor.column_rad)).astype(jnp.int32)
    if sensor.is_full_turn:
        return column % sensor.num_columns, jnp.ones(column.shape, bool)
    return column, column < sensor.num_columns


def wrap_angle(angle: Float[Array | np.ndarray, "*n"]) -> Float[Array | np.ndarray, "*n"]:
    """Wrap angles to [-pi, pi). NumPy input gives NumPy output, JAX input gives JAX output.

    >>> round(float(wrap_angle(jnp.float32(3.5))), 4)
    -2.7832
    """
    xp = jnp if isinstance(angle, Array) else np
    wrapped = angle - 2 * np.pi * xp.floor((angle + np.pi) / (2 * np.pi))
    # Rounding can give pi itself, which the interval excludes, or less than -pi.
    return xp.where((wrapped >= np.pi) | (wrapped < -np.pi), -np.pi, wrapped)


def rotation_matrix(rotation: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Rotation matrices for column vectors from quaternions w, x, y, z of any positive norm, on the host.

    >>> rotation_matrix(np.array([1.0, 0, 0, 1])).round(6).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    w, x, y, z = np.stack([w, x, y, z]) / np.sqrt(x * x + y * y + z * z + w * w)
    rows = (
        (x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def pose_matrix(
    rotation: Float64[np.ndarray, "*n 4"], translation: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 4 4"]:
    """Pose matrices for homogeneous column vectors from quaternions w, x, y, z and metres, on the host.

    >>> pose_matrix(np.array([1.0, 0, 0, 0]), np.array([1.0, 2, 3]))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    matrix = np.zeros((*rotation.shape[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation_matrix(rotation), translation, 1
    return matrix


def points_in_box(
    points: Float[Array | np.ndarray, "*n 3"], box: Float[Array | np.ndarray, "*m c"]
) -> Bool[Array | np.ndarray, "*o"]:
    """Whether points lie in boxes ``x, y, z, l, w, h, yaw, ...``, boundary included.

    Works elementwise with broadcasting, on NumPy or JAX arrays.

    >>> bool(points_in_box(jnp.array([2.0, 1.0, 0.0]), jnp.array([0, 0, 0, 4, 2, 2, 0.0])))
    True
    """
    check_columns("points", points, "x, y, z")
    check_columns("boxes", box, BOX)
    xp = jnp if isinstance(points, Array) else np
    dx, dy, dz = (points[..., i] - box[..., i] for i in range(3))
    cos, sin = xp.cos(box[..., 6]), xp.sin(box[..., 6])
    return (
        (abs(cos * dx + sin * dy) <= box[..., 3] / 2)
        & (abs(cos * dy - sin * dx) <= box[..., 4] / 2)
        & (abs(dz) <= box[..., 5] / 2)
    )
