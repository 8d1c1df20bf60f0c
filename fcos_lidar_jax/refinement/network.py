"""The network of the second look: a PointNet on the points of each box, and a comparison with its neighbours."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float32, Int32

from fcos_lidar_jax.geometry import atan2, safe_norm
from fcos_lidar_jax.initialization import kernel_init
from fcos_lidar_jax.refinement.types import LONGEST_M, Crops, LookInputs, Neighbours

REACH_M = 10.0
"""Largest distance of a neighbour on the ground."""
_FINE_M = 0.2  # Distance from the centre up to which asinh resolves positions finely.
_FAR_M = 1e6  # Distance of boxes that are no neighbours.
_FULL = lax.Precision.HIGHEST  # Positions would be rounded to TF32 or bfloat16 otherwise.


def point_features(crops: Crops, boxes: Float32[Array, "m c"]) -> Float32[Array, "m p 14"]:
    """Features of the points: position, distances to the six faces, intensity, fine position, time lag.

    A PointNet cannot see the size of the box in positions only, hence the distances to its faces (LiDAR R-CNN).
    Zero in slots without a point.
    """
    half = jnp.minimum(boxes[..., None, 3:6], LONGEST_M) / 2
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
    """Features of boxes around a sensor: class, logit of the score, log sizes, range, number of points, turn from
    the ray.

    With ``with_velocity`` (static) also the velocity along the heading and to the left.
    """
    turn = boxes[..., 6] - atan2(boxes[..., 1], boxes[..., 0])
    columns = [
        _logit(scores),
        *(_log_size(boxes)[..., i] for i in range(3)),
        safe_norm(boxes[..., 0], boxes[..., 1]) / 30,
        jnp.log1p(count) / 4,
        jnp.sin(turn),
        jnp.cos(turn),
    ]
    if with_velocity:
        cos, sin, vx, vy = jnp.cos(boxes[..., 6]), jnp.sin(boxes[..., 6]), boxes[..., 7], boxes[..., 8]
        columns += [(cos * vx + sin * vy) / 10, (cos * vy - sin * vx) / 10]
    return jnp.concatenate([jax.nn.one_hot(labels, num_classes), jnp.stack(columns, axis=-1)], axis=-1)


def find_neighbours(
    boxes: Float32[Array, "m c"],
    scores: Float32[Array, "m"],
    labels: Int32[Array, "m"],
    valid: Bool[Array, "m"],
    number: int,
) -> Neighbours:
    """Find the nearest other boxes of each box on the ground, at most ``REACH_M`` away.

    Objects stand in rows and side by side, and of two boxes on one object only one is right: this decides much of
    a score, and the points of a box do not show it.

    Args:
        boxes: ``x, y, z, l, w, h, yaw, ...``.
        number: maximum number of neighbours (static).

    Returns:
        neighbours, the nearest first. The features are the position of the neighbour in the frame of the box
        (asinh of metres), cosine and sine of its turn, whether the class is the same, and the differences of the
        logits of the scores and of the log sizes. Zero where invalid.

    >>> boxes = jnp.array([[0, 0, 0, 4, 2, 1, 0.0], [3, 0, 0, 4, 2, 1, 0], [50, 0, 0, 4, 2, 1, 0]])
    >>> found = find_neighbours(boxes, jnp.full(3, 0.5), jnp.zeros(3, int), jnp.ones(3, bool), 2)
    >>> found.index[:2, 0].tolist(), found.valid.tolist()
    ([1, 0], [[True, False], [True, False], [False, False]])
    """
    number = min(number, len(boxes))
    offset = boxes[None, :, :3] - boxes[:, None, :3]
    distance = safe_norm(offset[..., 0], offset[..., 1])
    other = jnp.asarray(valid) & ~jnp.eye(len(boxes), dtype=bool)
    closeness, index = lax.top_k(jnp.where(other & (distance < REACH_M), -distance, -_FAR_M), number)
    near = closeness > -_FAR_M
    dx, dy, dz = (jnp.take_along_axis(offset[..., i], index, axis=1) for i in range(3))
    cos, sin = jnp.cos(boxes[:, 6:7]), jnp.sin(boxes[:, 6:7])
    turn = boxes[index, 6] - boxes[:, 6:7]
    logit, size = _logit(scores), _log_size(boxes)
    columns = [
        *(jnp.arcsinh(x) for x in (cos * dx + sin * dy, cos * dy - sin * dx, dz)),
        jnp.cos(turn),
        jnp.sin(turn),
        (labels[index] == labels[:, None]).astype(jnp.float32),
        (logit[index] - logit[:, None]) / 4,  # about as large as the others
    ]
    features = jnp.concatenate([jnp.stack(columns, axis=-1), size[index] - size[:, None]], axis=-1)
    return Neighbours(index, near, jnp.where(near[..., None], features, 0.0))


class SecondLook(nn.Module):
    """Layers on each point, the maximum over the points of a box, layers on each box, and on pairs of neighbours.

    Returns class logits [..., k + 1], with the background last, and residuals [..., r].
    """

    num_classes: int
    residual_size: int  # Numbers of a residual, see ``targets.encode_residual``.
    point_channels: tuple[int, ...]
    box_channels: tuple[int, ...]
    pair_channels: tuple[int, ...]

    @nn.compact
    def __call__(
        self, inputs: LookInputs, *, train: bool = False
    ) -> tuple[Float32[Array, "*b k"], Float32[Array, "*b r"]]:
        x = inputs.points
        for layer, width in enumerate(self.point_channels):
            x = nn.Dense(width, kernel_init=_he, precision=_FULL, name=f"point{layer}")(x)
            x = jax.nn.relu(nn.LayerNorm(epsilon=1e-5, name=f"norm{layer}")(x))
        # ReLU makes zero the maximum over no points.
        x = jnp.concatenate([jnp.where(inputs.valid[..., None], x, 0.0).max(axis=-2), inputs.boxes], axis=-1)
        for layer, width in enumerate(self.box_channels):
            x = jax.nn.relu(nn.Dense(width, kernel_init=_he, name=f"box{layer}")(x))
        if inputs.neighbours is not None:
            compared = self._compare(x, inputs.neighbours)
            x = jax.nn.relu(nn.Dense(x.shape[-1], kernel_init=_he, name="together")(compared))
        x = nn.Dense(self.num_classes + 1 + self.residual_size, kernel_init=_small, name="out")(x)
        logits, residual = jnp.split(x, [self.num_classes + 1], axis=-1)
        return logits, residual.at[..., -1].add(1.0)  # Zero outputs leave a box as it is.

    def _compare(self, x: Array, neighbours: Neighbours) -> Array:
        """Each box, with the maximum and the sum of the layers over its pairs; the sum counts neighbours."""
        first, *deeper = self.pair_channels
        own, other = (nn.Dense(first, kernel_init=_he, name=name)(x) for name in ("own", "other"))
        pairs = nn.Dense(first, kernel_init=_he, use_bias=False, precision=_FULL, name="pair0")(
            neighbours.features
        )
        pairs = jax.nn.relu(own[..., None, :] + _rows(other, neighbours.index) + pairs)
        for layer, width in enumerate(deeper, start=1):
            pairs = jax.nn.relu(nn.Dense(width, kernel_init=_he, name=f"pair{layer}")(pairs))
        pairs = jnp.where(neighbours.valid[..., None], pairs, 0.0)
        return jnp.concatenate([x, pairs.max(axis=-2), pairs.sum(axis=-2) / 8], axis=-1)


_rows = jnp.vectorize(lambda x, index: x[index], signature="(m,c),(m,k)->(m,k,c)")


def _logit(scores: Array) -> Array:
    score = jnp.clip(scores, 1e-4, 1 - 1e-4)
    return jnp.log(score / (1 - score))


def _log_size(boxes: Array) -> Array:
    return jnp.log(jnp.maximum(boxes[..., 3:6], 0.05))


def _he(key: Array, shape: tuple[int, ...], dtype: object = None) -> Array:
    return kernel_init(key, shape) * np.sqrt(shape[1] / shape[0], dtype=np.float32)  # over the inputs


def _small(key: Array, shape: tuple[int, ...], dtype: object = None) -> Array:
    return 0.1 * _he(key, shape)
