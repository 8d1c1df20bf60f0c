"""Predictions and evaluations of frames."""

import dataclasses
import inspect

import jax
import numpy as np
import pytest
from refusal import refused
from tiny_run import FRAMES, TESTS

from fcos_lidar_jax.data.frame import Frame, WrappedFrames
from fcos_lidar_jax.inference import prediction
from fcos_lidar_jax.inference.prediction import evaluate, predict


@pytest.fixture
def compared(monkeypatch) -> list[Frame]:
    """Frames that an evaluation compares with."""
    frames, compare = list[Frame](), prediction.evaluate_frames
    monkeypatch.setattr(prediction, "evaluate_frames", lambda *args: frames.extend(args[1]) or compare(*args))
    return frames


def test_an_evaluation_does_not_keep_clouds(detector, compared):
    evaluate(detector, TESTS)
    assert [frame.points.shape for frame in compared] == 2 * [(0, 5)]
    assert all(frame.points.base is None for frame in compared), "a view of the whole cloud"


def test_missing_files_are_refused_before_a_frame_is_read(detector, monkeypatch):
    def missing(_, indices):
        raise ValueError(f"clouds {[*indices]}: missing")

    monkeypatch.setattr(type(TESTS), "check_files", missing)
    with refused("clouds [1]: missing"):
        predict(detector, TESTS, indices=[1])


class OnlyTruth(WrappedFrames):
    """Test frames whose clouds are on another machine."""

    def frame(self, index: int) -> Frame:
        raise OSError("not here")

    def truth(self, index: int) -> Frame:
        return dataclasses.replace(
            self.frames.truth(index), num_points=np.full(len(TESTS.labels(index)), 70 + index)
        )


def test_only_boxes_are_read_of_frames_that_another_process_has_read(detector, compared, monkeypatch):
    def read_elsewhere(*args, **options):
        return (dataclasses.replace(found, frame=None, cloud=None) for found in predict(detector, TESTS))

    monkeypatch.setattr(prediction, "predict", read_elsewhere)
    evaluate(detector, OnlyTruth(TESTS))
    assert [set(frame.num_points.tolist()) for frame in compared] == [{70}, {71}]
    np.testing.assert_array_equal(compared[1].boxes, TESTS.frame(1).boxes)


def test_frames_are_processed_in_order(detector):
    found = list(predict(detector, FRAMES, indices=[7, 3, 5], batch_size=2))
    assert [each.index for each in found] == [7, 3, 5]
    [alone] = predict(detector, FRAMES, indices=[3], batch_size=2)
    jax.tree.map(np.testing.assert_array_equal, alone.detections, found[1].detections)
    with pytest.raises(ValueError, match="frames: got 'str', expected a set of frames, as open_frames returns"):
        inspect.unwrap(predict)(detector, "my_lidar")  # without the type checks of the tests
    with pytest.raises(ValueError, match="batch_size: got 0, expected at least 1"):
        predict(detector, FRAMES, batch_size=0)
