"""Frames of two sets in turn."""

import dataclasses

import pytest

from experiments.mixed import MixedFrames
from fcos_lidar_jax.sensors import KITTI_HDL64E, TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

FIRST = SimulatedFrames(TINY, 6)
OTHER = dataclasses.replace(FIRST, num_objects=3)
MIXED = MixedFrames(FIRST, OTHER, 3)


def test_every_third_frame_is_of_the_other_set():
    for index in range(6):
        expected = (OTHER if index in (0, 3) else FIRST).frame(index)
        assert (MIXED.frame(index).points == expected.points).all()
        assert (MIXED.truth(index).boxes == expected.boxes).all()
        assert MIXED.labels(index).tolist() == expected.labels.tolist()
    assert (len(MIXED), MIXED.sensor, MIXED.name(3)) == (6, TINY, FIRST.name(3))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"number": 5}, "other: length: got 5, expected that of the frames, 6"),
        ({"sensor": KITTI_HDL64E}, "other: sensor: got "),
    ],
)
def test_sets_that_do_not_fit_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        MixedFrames(FIRST, dataclasses.replace(FIRST, **changed), 3)
