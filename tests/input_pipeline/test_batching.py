"""Batches of given frames."""

import dataclasses

import numpy as np
import pytest

import fcos_lidar_jax as fcos
from fcos_lidar_jax.data.frame import InMemoryFrames
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames


def test_frames_are_padded_and_nothing_is_truncated():
    frames = [SimulatedFrames(TINY, 2).frame(index) for index in range(2)]
    batch = fcos.input_pipeline.make_batch(frames, max_points=4096, max_boxes=64)
    for row, frame in enumerate(frames):
        np.testing.assert_array_equal(batch.points[row][batch.valid[row]], frame.points)
        np.testing.assert_array_equal(batch.boxes[row][batch.box_valid[row]], frame.boxes)
        np.testing.assert_array_equal(batch.labels[row][batch.box_valid[row]], frame.labels)
    with pytest.raises(ValueError, match=rf"^frame 0: points: got {len(frames[0].points)}, expected at most 9$"):
        fcos.input_pipeline.make_batch(frames, max_points=9, max_boxes=64)


FRAME = SimulatedFrames(TINY, 1).frame(0)
NUMBER = len(FRAME.boxes)
RINGED = FRAME.points + np.float32([0, 0, 0, 0, 7])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"boxes": FRAME.boxes[:, :7]}, rf"boxes: shape: got \({NUMBER}, 7\), expected \({NUMBER}, 9\)"),
        ({"boxes": FRAME.boxes * np.nan}, "box 0: x: got nan, expected a finite number"),
        ({"boxes": FRAME.boxes * -1}, "box 0: l: got -.*, expected a size above 0 m"),
        ({"labels": FRAME.labels[1:]}, rf"labels: shape: got \({NUMBER - 1},\), expected \({NUMBER},\)"),
        ({"labels": FRAME.labels - 99}, "labels: got -.*, expected indices of classes, from 0"),
        ({"num_points": FRAME.num_points[1:]}, "num_points: shape"),
        ({"points": RINGED}, "points: fifth column: got whole numbers up to 7, which look like a ring"),
    ],
)
def test_frames_that_would_train_something_else_are_refused(fields, message):
    with pytest.raises(ValueError, match=f"^frame 0: {message}"):
        fcos.input_pipeline.make_batch([dataclasses.replace(FRAME, **fields)], max_points=4096, max_boxes=64)


def test_frames_in_memory_have_labels_of_their_classes_and_no_rings():
    for fields, message in (
        ({"labels": FRAME.labels * 0 + 2}, r"labels: got \[2.*\], expected indices of the 2 classes"),
        ({"points": RINGED, "labels": FRAME.labels * 0}, "points: fifth column: got whole"),
    ):
        with pytest.raises(ValueError, match=f"^frame 0: {message}"):
            InMemoryFrames((dataclasses.replace(FRAME, **fields),), TINY, ("car", "truck"))
