"""Class-balanced resampling against shares counted by hand."""

import numpy as np
import pytest

from fcos_lidar_jax.data.resampling import class_balanced_frames

# Class 0 in 80 frames, class 4 in 20 of them, class 9 in 5 others; 15 frames are empty.
LABELS = [np.array([0, 0, 0]), np.array([0, 4]), np.array([9]), np.array([], np.int32)]
SHOWS = [LABELS[k] for k in [0] * 60 + [1] * 20 + [2] * 5 + [3] * 15]


def test_every_class_gets_the_same_number_of_draws():
    frames = class_balanced_frames(SHOWS, seed=3)
    # N = 80 + 20 + 5 = 105 over 3 classes: 35 draws each.
    assert len(frames) == 105
    drawn_for = np.split(frames, 3)
    assert set(drawn_for[0]) <= set(range(80))
    assert set(drawn_for[1]) <= set(range(60, 80))
    assert set(drawn_for[2]) == set(range(80, 85))
    assert len(set(drawn_for[0])) > 20


def test_share_of_a_rare_class_rises():
    frames = class_balanced_frames(SHOWS, seed=0)
    shows = {label: np.mean([label in SHOWS[i] for i in frames]) for label in (0, 4, 9)}
    before = {label: np.mean([label in s for s in SHOWS]) for label in (0, 4, 9)}
    assert before == {0: 0.8, 4: 0.2, 9: 0.05}
    assert shows[9] == pytest.approx(1 / 3)
    assert 1 / 3 < shows[4] < 0.6  # a third by its own draws, a quarter of class 0's draws by chance
    assert shows[0] == pytest.approx(2 / 3)


def test_each_of_a_class_frames_has_the_same_chance():
    many = np.concatenate([class_balanced_frames(SHOWS, seed=s)[35:70] for s in range(200)])
    counts = np.bincount(many - 60, minlength=20)
    expected = 200 * 35 / 20
    assert ((counts - expected) ** 2 / expected).sum() < 43.8  # chi-squared, 19 degrees of freedom, 0.1 %


def test_classes_that_share_their_frames_have_draws_of_their_own():
    both = [np.array([0, 4])] * 30
    first, second = np.split(class_balanced_frames(both, seed=0), 2)
    assert (first != second).any()


def test_the_seed_decides():
    a, b, c = (class_balanced_frames(SHOWS, seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


def test_without_objects_it_is_one_line():
    with pytest.raises(ValueError, match="none of the 2 frames shows an object"):
        class_balanced_frames([np.zeros(0, np.int32)] * 2, seed=0)
