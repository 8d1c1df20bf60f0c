"""Arrays that do not fit each other are refused by functions whose annotations nobody checks."""

import inspect

import numpy as np
import pytest

from fcos_lidar_jax import assignment, losses, nms


def z(*shape, dtype=np.float32):
    return np.zeros(shape, dtype)


MASK, ONE, BOXES_MASK = z(3, dtype=bool), z(1, dtype=bool), z(2, dtype=bool)
KEPT = z(2, dtype=np.int32), BOXES_MASK
LABELS = {"labels": z(1, dtype=np.int32)}
LIMITS = {"iou_threshold": 0.5, "max_outputs": 2}
CASES = [
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
    (losses.iou_prediction_loss, (z(3), z(3), ONE), {}, "mask: got shape (1,), expected (3,)"),
    (nms.rotated_nms, (z(2, 7), z(3), MASK), LIMITS, "scores: got shape (3,), expected (2,)"),
    (nms.rotated_nms, (z(2, 7), z(2), BOXES_MASK), LIMITS | LABELS, "labels: got shape (1,), expected (2,)"),
    (nms.merge_boxes, (z(2, 7), z(2), ONE, *KEPT), {"iou_threshold": 0.5}, "valid: got shape (1,), expected (2,)"),
    (assignment.owners, (z(3, 3), ONE, z(2, 7), BOXES_MASK), {}, "present: got shape (1,), expected (3,)"),
    (assignment.owners, (z(3, 3), MASK, z(2, 7), ONE), {}, "box_valid: got shape (1,), expected (2,)"),
    (
        assignment.assign,
        (z(3, dtype=np.int32), z(1), z(3)),
        {"num_boxes": 2},
        "classification_cost: got shape (1,), expected (3,)",
    ),
]


@pytest.mark.parametrize(("function", "args", "options", "message"), CASES)
def test_other_lengths_are_refused_instead_of_broadcast_or_clamped(function, args, options, message):
    unchecked = inspect.unwrap(function)  # without the shapes that the tests check in signatures
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        unchecked(*args, **options)
    assert str(caught.value) == message
