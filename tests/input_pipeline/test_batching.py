"""Batches of given frames."""

import numpy as np
import pytest

import fcos_lidar_jax as fcos
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
    with pytest.raises(ValueError, match=r"^frames: got none"):
        fcos.input_pipeline.make_batch([], max_points=9, max_boxes=64)
