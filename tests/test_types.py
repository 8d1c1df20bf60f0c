"""Arrays and options that do not fit are refused by functions whose annotations nobody checks."""

import inspect
import re

import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax import assignment, geometry, iou, losses, nms
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import ARGOVERSE2, TINY
from fcos_lidar_jax.types import check_columns


def z(*shape, dtype=np.float32):
    return np.zeros(shape, dtype)


MASK, ONE, TWO = z(3, dtype=bool), z(1, dtype=bool), z(2, dtype=bool)
KEPT = jnp.zeros(2, jnp.int32), jnp.zeros(2, bool)
LABELS = {"labels": z(1, dtype=np.int32)}
LIMITS = {"iou_threshold": 0.5, "max_outputs": 2}
SHAPES = "points, valid: got shapes {} and {}, expected (n, c) and (n,); use jax.vmap for batches"
LENGTHS = [
    (losses.cross_entropy, (z(3, 2), z(1, dtype=np.int32)), {}, "labels: got shape (1,), expected (3,)"),
    (losses.classification_loss, (z(3, 2), z(3, dtype=np.int32), ONE), {}, "mask: got shape (1,), expected (3,)"),
    (
        losses.l1_loss,
        (z(3, 10), z(1, 10), MASK),
        {"velocity_weight": 1.0},
        "target: got shape (1, 10), expected (3, ...)",
    ),
    (losses.iou_loss, (z(3, 8), z(3, 8), ONE), {}, "mask: got shape (1,), expected (3,)"),
    (losses.iou_prediction_loss, (z(3, 1), z(3), MASK), {}, "logits: got shape (3, 1), expected (3,)"),
    (nms.rotated_nms, (z(2, 7), z(3), MASK), LIMITS, "scores: got shape (3,), expected (2,)"),
    (nms.rotated_nms, (z(2, 7), z(2), TWO), LIMITS | LABELS, "labels: got shape (1,), expected (2,)"),
    (project_points, (z(2, 9, 5), z(2, 9, dtype=bool), TINY), {}, SHAPES.format((2, 9, 5), (2, 9))),
    (project_points, (z(3, 5), TWO, TINY), {}, SHAPES.format((3, 5), (2,))),
    (nms.merge_boxes, (z(2, 7), z(2), ONE, *KEPT), {"iou_threshold": 0.5}, "valid: got shape (1,), expected (2,)"),
    (assignment.owners, (z(3, 3), ONE, z(2, 7), TWO), {}, "present: got shape (1,), expected (3,)"),
    (assignment.owners, (z(3, 3), MASK, z(2, 7), ONE), {}, "box_valid: got shape (1,), expected (2,)"),
    (
        assignment.assign,
        (z(3, dtype=np.int32), z(1), z(3)),
        {"num_boxes": 2},
        "classification_cost: got shape (1,), expected (3,)",
    ),
]
BOX = "expected columns x, y, z, l, w, h, yaw, ..."
ORIENTED = "expected columns x, y, z, l, w, h, cos yaw, sin yaw"
LAYOUTS = [
    (geometry.points_in_box, (z(1, 3), z(1, 5)), {}, f"boxes: got shape (1, 5), {BOX}"),
    (iou.rotated_iou_bev, (z(1, 5), z(1, 5)), {}, f"boxes: got shape (1, 5), {BOX}"),
    (iou.rotated_iou_3d, (z(1, 7), z(1, 5)), {}, f"boxes: got shape (1, 5), {BOX}"),
    (nms.rotated_nms, (z(2, 5), z(2), TWO), LIMITS, f"boxes: got shape (2, 5), {BOX}"),
    (nms.merge_boxes, (z(2, 5), z(2), TWO, *KEPT), {"iou_threshold": 0.5}, f"boxes: got shape (2, 5), {BOX}"),
    (assignment.owners, (z(3, 3), MASK, z(2, 5), TWO), {"form": "loop"}, f"boxes: got shape (5,), {BOX}"),
    (losses.iou_loss, (z(1, 7), z(1, 8), ONE), {}, f"prediction: got shape (1, 7), {ORIENTED}"),
    (losses.iou_loss, (z(1, 8), z(1, 9), ONE), {}, f"target: got shape (1, 9), {ORIENTED}"),
    (check_columns, ("value", z(2, 9), "x, y, z"), {}, "value: got shape (2, 9), expected columns x, y, z"),
    (check_columns, ("box", z(), "x, ..."), {}, "box: got shape (), expected columns x, ..."),
    (project_points, (z(3, 5), MASK, ARGOVERSE2), {}, "points: got 5 columns, expected 6 for sensor 'argovers"),
]
OVERLAPS = "overlap: got 'BEV', expected 'bev' or '3d'"
OPTIONS = [
    (project_points, (z(3, 5), MASK, TINY), {"num_rounds": 0}, "num_rounds: got 0, expected at least 1"),
    (nms.rotated_nms, (z(2, 7), z(2), TWO), LIMITS | {"max_outputs": 0}, "max_outputs: got 0, expected at lea"),
    (nms.rotated_nms, (z(2, 7), z(2), TWO), LIMITS | {"overlap": "BEV"}, OVERLAPS),
    (losses.iou_loss, (z(1, 8), z(1, 8), ONE), {"kind": "ciou"}, "kind: got 'ciou'"),
]


@pytest.mark.parametrize(("function", "args", "options", "message"), LENGTHS + LAYOUTS + OPTIONS)
def test_wrong_arguments_are_refused_instead_of_broadcast_or_clamped(function, args, options, message):
    unchecked = inspect.unwrap(function)  # without the shapes that the tests check in signatures
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        unchecked(*args, **options)


def test_columns_may_follow_where_the_layout_says_so():
    check_columns("box", z(2, 9), "x, y, z, ...")
