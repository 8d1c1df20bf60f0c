"""Targets, heat-map loss and coding of boxes for CenterPoint (Yin et al., CVPR 2021)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Float32, Int32

from fcos_lidar_jax.centerpoint.pillars import Grid, cell_positions, cells_below
from fcos_lidar_jax.coding import decode, decode_oriented, encode

_HARMLESS = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


class CentreTargets(NamedTuple):
    """Targets of one sample."""

    heat: Array  # f32[h, w, k]: Gaussians with a maximum of 1 at the centres.
    cell: Array  # i32[m]: cell of each box's centre, 0 for invalid boxes.
    boxes: Array  # f32[m, 9], with harmless values for invalid boxes.
    valid: Array  # bool[m]: boxes with a centre on the map.


def gaussian_radius(
    length: Float[Array, "*m"], width: Float[Array, "*m"], *, min_overlap: float
) -> Float[Array, "*m"]:
    """Compute the radius of a Gaussian as CornerNet and CenterPoint do.

    The minimum of the solutions of three quadratic equations, one for each way in which two aligned boxes can
    overlap. Each solution is the larger root with 2 as the denominator, whatever the leading coefficient.

    >>> round(float(gaussian_radius(jnp.float32(5), jnp.float32(2.5), min_overlap=0.1)), 3)
    1.5
    """
    total, area = length + width, length * width

    def larger(a: float, b: Array, c: Array) -> Array:
        return (b + jnp.sqrt(jnp.maximum(b * b - 4 * a * c, 0.0))) / 2

    one_corner = larger(1, total, area * (1 - min_overlap) / (1 + min_overlap))
    inside = larger(4, 2 * total, area * (1 - min_overlap))
    around = larger(4 * min_overlap, -2 * min_overlap * total, area * (min_overlap - 1))
    return jnp.minimum(jnp.minimum(one_corner, inside), around)


def centre_targets(
    boxes: Float32[Array, "m 9"],
    labels: Int32[Array, "m"],
    box_valid: Bool[Array, "m"],
    *,
    grid: Grid,
    num_classes: int,
    min_overlap: float,
    min_radius: int,
) -> CentreTargets:
    """Place Gaussians at the box centres of one sample, with the maximum where Gaussians of a class overlap.

    Arguments after the arrays are static.

    >>> box = jnp.array([[1.5, 0.5, 0, 1, 1, 1, 0, 0, 0]], jnp.float32)
    >>> options = dict(grid=Grid(4, 1.0, (0.0, 0.0)), num_classes=1, min_overlap=0.1, min_radius=1)
    >>> centre_targets(box, jnp.array([0]), jnp.array([True]), **options).heat[0, :, 0].round(2).tolist()
    [0.14000000059604645, 1.0, 0.14000000059604645, 0.0]
    """
    cell, inside = cells_below(boxes[:, :2], grid)
    valid = box_valid & inside
    boxes = jnp.where(valid[:, None], boxes, jnp.array(_HARMLESS, boxes.dtype))
    length, width = boxes[:, 3] / grid.cell_m, boxes[:, 4] / grid.cell_m
    radius = gaussian_radius(length, width, min_overlap=min_overlap)
    radius = jnp.maximum(jnp.floor(radius), min_radius)
    sigma = (2 * radius + 1) / 6
    steps = jnp.arange(grid.side)

    def profile(centre: Array) -> Array:
        away = (steps - centre[:, None]).astype(jnp.float32)
        values = jnp.exp(-away * away / (2 * sigma * sigma)[:, None])
        return jnp.where((jnp.abs(away) <= radius[:, None]) & valid[:, None], values, 0.0)

    cell, label = jnp.where(valid, cell, 0), jnp.where(valid, labels, 0)
    by_row, by_column = profile(cell // grid.side), profile(cell % grid.side)

    def add(i: Array, heat: Array) -> Array:
        spot = by_row[i][:, None] * by_column[i]
        return heat.at[label[i]].max(spot)

    heat = jnp.zeros((num_classes, grid.side, grid.side), jnp.float32)
    heat = lax.fori_loop(0, boxes.shape[0], add, heat)
    return CentreTargets(jnp.moveaxis(heat, 0, -1), cell, boxes, valid)


def focal_loss(
    logits: Float[Array, "h w k"],
    heat: Float32[Array, "h w k"],
    cell: Int32[Array, "m"],
    labels: Int32[Array, "m"],
    valid: Bool[Array, "m"],
) -> tuple[Float[Array, "k"], Float[Array, "m"]]:
    """Compute the penalty-reduced focal loss of the heat map with alpha 2 and beta 4, as sums.

    Args:
        heat, cell, valid: from :func:`centre_targets`.

    Returns:
        the loss of each class over all cells without a centre of it, and the loss of each box at its centre.

    >>> no_box = jnp.zeros(1, jnp.int32), jnp.zeros(1, jnp.int32), jnp.zeros(1, bool)
    >>> away, at_boxes = focal_loss(jnp.zeros((1, 1, 1)), jnp.zeros((1, 1, 1)), *no_box)
    >>> round(float(away[0]), 4), float(at_boxes[0])  # 0.5 ** 2 * ln 2
    (0.1733, 0.0)
    """
    away = jnp.square(jax.nn.sigmoid(logits)) * jax.nn.softplus(logits) * (1 - heat) ** 4
    at_box = logits.reshape(-1, logits.shape[-1])[cell, jnp.where(valid, labels, 0)]
    missed = jnp.square(jax.nn.sigmoid(-at_box)) * jax.nn.softplus(-at_box)
    return away.sum(axis=(0, 1)), jnp.where(valid, missed, 0.0)


def encode_centres(boxes: Float32[Array, "*m 9"], cell: Int32[Array, "*m"], grid: Grid) -> Float32[Array, "*m 10"]:
    """Compute the regression targets of boxes: :func:`fcos_lidar_jax.coding.encode` with x and y in cells.

    >>> box = jnp.array([1.5, 0.5, 0, 1, 1, 1, 0, 0, 0], jnp.float32)
    >>> encode_centres(box, jnp.int32(0), Grid(2, 2.0, (0.0, 0.0)))[:2].tolist()
    [0.75, 0.25]
    """
    numbers = encode(boxes, _corners(cell, grid), jnp.zeros(cell.shape))
    return numbers.at[..., :2].divide(grid.cell_m)


def decode_centres(
    regression: Float[Array, "*m 10"],
    cell: Int32[Array, "*m"],
    grid: Grid,
    *,
    oriented: bool = False,
) -> Float[Array, "*m _"]:
    """Decode boxes from the ten numbers of a cell, the inverse of :func:`encode_centres`.

    The result is ``x, y, z, l, w, h, yaw, vx, vy``, or with ``oriented`` the form of
    :func:`fcos_lidar_jax.coding.decode_oriented`.

    >>> box, cell, grid = jnp.arange(1, 10.0).at[6].set(0.5), jnp.int32(5), Grid(3, 2.0, (0.0, 0.0))
    >>> bool(jnp.allclose(decode_centres(encode_centres(box, cell, grid), cell, grid), box, atol=1e-5))
    True
    """
    function = decode_oriented if oriented else decode
    numbers = regression.at[..., :2].multiply(grid.cell_m)
    return function(numbers, _corners(cell, grid), jnp.zeros(cell.shape))


def _corners(cell: Array, grid: Grid) -> Array:
    corners = cell_positions(cell, grid)
    return jnp.concatenate([corners, jnp.zeros_like(corners[..., :1])], axis=-1)
