"""Targets of the second look: the class and the residual of each box."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.geometry import atan2, safe_norm, wrap_angle
from fcos_lidar_jax.refinement.types import RefinementTargets

_FAR_M = 1e6  # Cost of a pair that is too far apart.
_MIN_SIZE_M = 0.05
_MAX_LOG_RATIO = 1.0  # A box grows or shrinks by at most this factor's logarithm.


def match_boxes(
    boxes: Float32[Array, "m c"],
    labels: Int32[Array, "m"],
    valid: Bool[Array, "m"],
    true_boxes: Float32[Array, "t k"],
    true_labels: Int32[Array, "t"],
    true_valid: Bool[Array, "t"],
    *,
    num_classes: int,
    radius_range_m: tuple[float, float],
    between_weight: float = 0.3,
    with_velocity: bool = False,
) -> RefinementTargets:
    """Find the box that stands for each object: the nearest of its class, or else the nearest of any class.

    A box belongs to the object whose centre is nearest on the ground, among objects of its own class first. The
    radius of an object is half of its longer side, within limits. Of the boxes within the radius, one stands for
    the object. The others are duplicates: their class is the background, but they have a residual.

    Args:
        boxes, labels, valid: boxes of the detector, best first.
        true_boxes, true_labels, true_valid: ground truth.
        num_classes: number of classes, which is also the label of the background (static).
        radius_range_m: limits of the radius (static).
        between_weight: weight of boxes between one and two radii, which are neither right nor wrong (static).
        with_velocity: the residual includes the velocity (static); NaN where that of the object is unknown.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0.0], [0.3, 0, 0, 4, 2, 1, 0], [9, 0, 0, 4, 2, 1, 0]])
    >>> car, yes = jnp.zeros(1, int), jnp.ones(1, bool)
    >>> truth = jnp.array([[0.2, 0, 0, 4, 2, 1, 0.0]]), car, yes
    >>> labels, valid = jnp.array([0, 1, 0]), jnp.ones(3, bool)
    >>> match_boxes(boxes, labels, valid, *truth, num_classes=2, radius_range_m=(1.0, 2.0)).label.tolist()
    [0, 2, 2]
    """
    boxes, true_boxes = jnp.asarray(boxes, jnp.float32), jnp.asarray(true_boxes, jnp.float32)
    if not len(true_boxes):  # one object that does not exist, because none cannot be gathered
        true_boxes, true_labels = jnp.ones((1, 9), jnp.float32), jnp.zeros(1, jnp.int32)
        true_valid = jnp.zeros(1, bool)
    true_labels, true_valid = jnp.asarray(true_labels, jnp.int32), jnp.asarray(true_valid)
    low, high = radius_range_m
    radius = jnp.clip(true_boxes[:, 3:5].max(axis=1) / 2, low, high)
    offset = boxes[:, None, :2] - true_boxes[None, :, :2]
    distance = safe_norm(offset[..., 0], offset[..., 1])
    pair = jnp.asarray(valid)[:, None] & true_valid
    near = pair & (distance < radius)
    other = jnp.asarray(labels)[:, None] != true_labels
    cost = jnp.where(near, distance + jnp.where(other, 2 * high, 0.0), _FAR_M)
    owner = cost.argmin(axis=1)
    cost = jnp.where(jnp.arange(len(true_boxes)) == owner[:, None], cost, _FAR_M)
    box_near = (cost < _FAR_M).any(axis=1)
    best, found = _first_of_all(cost)
    label = jnp.full(len(boxes), num_classes, jnp.int32)
    label = label.at[jnp.where(found, best, len(boxes))].set(true_labels, mode="drop")
    between = ~box_near & (pair & (distance < 2 * radius)).any(axis=1)
    weight = jnp.where(between, between_weight, 1.0) * jnp.asarray(valid)
    # Boxes without an object get themselves as a harmless object.
    columns = 9 if with_velocity else 7
    target = jnp.where(box_near[:, None], true_boxes[owner][:, :columns], boxes[:, :columns])
    residual = jnp.where(box_near[:, None], encode_residual(boxes, target), 0.0)
    return RefinementTargets(label, residual, box_near, weight.astype(jnp.float32))


def _first_of_all(cost: Array) -> tuple[Array, Array]:
    """Row of the lowest cost in each column, and whether there is one."""
    if not len(cost):
        return jnp.zeros(cost.shape[1], jnp.int32), jnp.zeros(cost.shape[1], bool)
    return cost.argmin(axis=0), cost.min(axis=0) < _FAR_M


def encode_residual(boxes: Float32[Array, "m c"], targets: Float32[Array, "m k"]) -> Float32[Array, "m r"]:
    """Residual from boxes to targets, in the frame of each box.

    Offset of the centre along the heading, to the left and upwards (metres), log ratios of length, width and
    height, change of the velocity along the heading and to the left (m/s) if the targets have nine columns, sine
    and cosine of the turn. The residual of a box to itself is zero but for the cosine.

    >>> box = jnp.array([[0, 0, 0, 4, 2, 1, jnp.pi / 2]])
    >>> encode_residual(box, box.at[0, 1].set(3.0))[0].round().tolist()
    [3.0, -0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    """
    cos, sin = jnp.cos(boxes[:, 6]), jnp.sin(boxes[:, 6])
    dx, dy, dz = (targets[:, i] - boxes[:, i] for i in range(3))
    size = jnp.log(jnp.maximum(targets[:, 3:6], _MIN_SIZE_M) / jnp.maximum(boxes[:, 3:6], _MIN_SIZE_M))
    turn = targets[:, 6] - boxes[:, 6]
    place = jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, dz], axis=1)
    parts = [place, size]
    if targets.shape[1] > 7:
        vx, vy = (targets[:, i] - boxes[:, i] for i in (7, 8))
        parts.append(jnp.stack([cos * vx + sin * vy, cos * vy - sin * vx], axis=1))
    return jnp.concatenate([*parts, jnp.sin(turn)[:, None], jnp.cos(turn)[:, None]], axis=1)


def move_boxes(boxes: Float32[Array, "m c"], residual: Float32[Array, "m r"]) -> Float32[Array, "m c"]:
    """Inverse of :func:`encode_residual`; the velocity is unchanged if the residual has none.

    Sizes change by at most a factor of e.

    >>> box = jnp.array([[1.0, 2, 0, 4, 2, 1, 0.5, 7, 8]])
    >>> moved = move_boxes(box, encode_residual(box, box.at[0, 3].set(5.0)))
    >>> moved[0].round(4).tolist()
    [1.0, 2.0, 0.0, 5.0, 2.0, 1.0, 0.5, 7.0, 8.0]
    """
    cos, sin = jnp.cos(boxes[:, 6]), jnp.sin(boxes[:, 6])
    along, left, up = (residual[:, i] for i in range(3))
    place = boxes[:, :3] + jnp.stack([cos * along - sin * left, sin * along + cos * left, up], axis=1)
    size = boxes[:, 3:6] * jnp.exp(jnp.clip(residual[:, 3:6], -_MAX_LOG_RATIO, _MAX_LOG_RATIO))
    yaw = wrap_angle(boxes[:, 6] + atan2(residual[:, -2], residual[:, -1]))
    velocity = boxes[:, 7:]
    if residual.shape[1] > 8:
        along, left = residual[:, 6], residual[:, 7]
        velocity += jnp.stack([cos * along - sin * left, sin * along + cos * left], axis=1)
    return jnp.concatenate([place, size, yaw[:, None], velocity], axis=1)
