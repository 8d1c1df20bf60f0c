"""Arrays that do not fit each other are refused by functions whose annotations nobody checks."""

import json

from commands import run_python

CODE = """
import json
import numpy as np
from fcos_lidar_jax import assignment, losses, nms

def z(*shape, dtype=np.float32):
    return np.zeros(shape, dtype)

def refused(function, *args, **options):
    try:
        function(*args, **options)
    except ValueError as error:
        return str(error)

mask, one = z(3, dtype=bool), z(1, dtype=bool)
limits = {"iou_threshold": 0.5, "max_outputs": 2}
kept = z(2, dtype=np.int32), z(2, dtype=bool)
box_mask = z(2, dtype=bool)
print(json.dumps([
    refused(losses.classification_loss, z(3, 2), z(1, dtype=np.int32), mask),
    refused(losses.classification_loss, z(3, 2), z(3, dtype=np.int32), one),
    refused(losses.l1_loss, z(3, 10), z(1, 10), mask, velocity_weight=1.0),
    refused(losses.iou_loss, z(3, 8), z(3, 8), one),
    refused(losses.iou_prediction_loss, z(3, 1), z(3), mask),
    refused(losses.iou_prediction_loss, z(3), z(3), one),
    refused(nms.rotated_nms, z(2, 7), z(3), mask, **limits),
    refused(nms.rotated_nms, z(2, 7), z(2), box_mask, labels=z(1, dtype=np.int32), **limits),
    refused(nms.merge_boxes, z(2, 7), z(2), one, *kept, iou_threshold=0.5),
    refused(assignment.owners, z(3, 3), one, z(2, 7), box_mask),
    refused(assignment.owners, z(3, 3), mask, z(2, 7), one),
    refused(assignment.assign, z(3, dtype=np.int32), z(1), z(3), num_boxes=2),
]))
"""
EXPECTED = [
    "labels: got shape (1,), expected (3,)",
    "mask: got shape (1,), expected (3,)",
    "target: got shape (1, 10), expected (3, ...)",
    "mask: got shape (1,), expected (3,)",
    "logits: got shape (3, 1), expected (3,)",
    "mask: got shape (1,), expected (3,)",
    "scores: got shape (3,), expected (2,)",
    "labels: got shape (1,), expected (2,)",
    "valid: got shape (1,), expected (2,)",
    "present: got shape (1,), expected (3,)",
    "box_valid: got shape (1,), expected (2,)",
    "classification_cost: got shape (1,), expected (3,)",
]


def test_other_lengths_are_refused_instead_of_broadcast_or_clamped():
    done = run_python("-c", CODE)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == EXPECTED
