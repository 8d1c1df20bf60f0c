"""The order of samples: shares of the classes against numbers computed by hand, sampled anew in every epoch."""

import dataclasses

import numpy as np
import pytest
from refusal import refused
from toy_frames import ListedFrames

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.input_pipeline.loader import SampleOrder, steps_per_epoch
from fcos_lidar_jax.presets import NUSCENES

# Class 0 in 80 frames, class 4 in 20 of them, class 9 in 5 others; 15 frames are empty.
LABELS = [np.array([0, 0, 0]), np.array([0, 4]), np.array([9]), np.array([], np.int32)]
SHOWS = [LABELS[k] for k in [0] * 60 + [1] * 20 + [2] * 5 + [3] * 15]
SHARE = 35  # of 80 + 20 + 5 = 105 draws over 3 classes


def frames_with(labels):
    none = np.zeros((0, 5), np.float32)
    return ListedFrames(tuple(Frame(none, np.zeros((len(l), 9)), l, np.ones(len(l))) for l in labels))


def order_of(labels, seed=0, *, balanced=True):
    return SampleOrder(frames_with(labels), dataclasses.replace(NUSCENES, class_balanced=balanced), seed=seed)


def epoch_of(order, epoch=0):
    return [order[epoch * order.epoch_size + i] for i in range(order.epoch_size)]


@pytest.mark.parametrize("epoch", [0, 5])
def test_every_epoch_samples_equally_often_for_each_class(epoch):
    frames = np.array(epoch_of(order_of(SHOWS, seed=3), epoch))
    assert len(frames) == 3 * SHARE
    # Only the samples for class 9 show it; samples for class 0 may also show class 4.
    assert (frames >= 80).sum() == SHARE
    assert set(frames) <= set(range(85))
    assert SHARE <= ((frames >= 60) & (frames < 80)).sum() < 2 * SHARE
    assert len(set(frames[frames < 60])) > 10


def test_all_frames_of_a_class_are_equally_likely():
    order = order_of(SHOWS)
    many = np.concatenate([epoch_of(order, epoch) for epoch in range(10)])
    counts = np.bincount(many[many >= 80] - 80, minlength=5)
    expected = 10 * SHARE / 5
    assert ((counts - expected) ** 2 / expected).sum() < 18.5  # chi-squared, 4 degrees of freedom, 0.1 %


def test_classes_that_share_their_frames_are_sampled_independently():
    """All frames show both classes: sixty samples from thirty frames, not each frame twice."""
    counts = np.bincount(epoch_of(order_of([np.array([0, 4])] * 30)), minlength=30)
    assert counts.sum() == 60
    assert (counts % 2).any()


def test_the_order_depends_only_on_the_seed_and_the_position():
    a, b, c = (order_of(SHOWS, seed=s) for s in (5, 5, 6))
    assert epoch_of(a, 1) == epoch_of(b, 1) != epoch_of(c, 1)
    epochs = [epoch_of(a, epoch) for epoch in range(4)]
    assert len({tuple(sorted(epoch)) for epoch in epochs}) == 4  # sampled anew
    assert all(epoch != sorted(epoch) for epoch in epochs)  # shuffled
    backwards = [b[position] for position in reversed(range(a.epoch_size, 2 * a.epoch_size))]
    assert backwards[::-1] == epoch_of(a, 1)


def test_without_class_balance_every_epoch_has_each_frame_once():
    order, neighbour = order_of(SHOWS, balanced=False), order_of(SHOWS, seed=1, balanced=False)
    epochs = [epoch_of(order, epoch) for epoch in range(4)]
    assert all(sorted(epoch) == list(range(100)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4
    # Neighbouring seeds do not share epochs.
    assert not {tuple(epoch) for epoch in epochs} & {tuple(epoch_of(neighbour, epoch)) for epoch in range(4)}
    # Golden values: a resumed run needs the order of its beginning.
    assert epoch_of(order)[:8] == [87, 61, 50, 7, 70, 72, 24, 52]
    assert epoch_of(order, 1)[:4] == [83, 27, 4, 75]


def test_steps_per_epoch_are_rounded_up():
    config = dataclasses.replace(NUSCENES, optimizer=dataclasses.replace(NUSCENES.optimizer, batch_size=32))
    plain = dataclasses.replace(config, class_balanced=False)
    assert steps_per_epoch(frames_with(SHOWS), config) == 4  # 105 samples
    assert steps_per_epoch(frames_with(SHOWS), plain) == 4  # 100 frames
    assert steps_per_epoch(frames_with(SHOWS[:96]), plain) == 3


def test_frames_without_objects_are_refused():
    with refused("class balance: none of the 2 frames shows an object"):
        order_of([np.zeros(0, np.int32)] * 2)
