"""Class-balanced resampling of frames (CBGS, Zhu et al. 2019)."""

from collections.abc import Sequence

import numpy as np

_TAG = 0xCB65


def class_balanced_frames(labels: Sequence[np.ndarray], *, seed: int) -> np.ndarray:
    """Frames, some of them many times, so that every class is drawn for equally often.

    With n_c frames that show class c, N their sum over the classes and C classes that occur at all, floor(N / C)
    frames are drawn for every class, with replacement and equal chances, from the n_c. Frames without any box are
    never drawn. The list is fixed for a run; it is to be shuffled anew in every epoch.

    Args:
        labels: of every frame, i32[m] each.
        seed: of the draws.

    Returns:
        i64[C * floor(N / C)]: indices of frames, class by class.

    Raises:
        ValueError: no frame shows an object.

    >>> shows = [np.array([0]), np.array([0, 0]), np.array([0, 3]), np.array([])]
    >>> class_balanced_frames(shows, seed=0).tolist()[2:]
    [2, 2]
    """
    showing: dict[int, list[int]] = {}
    for frame, present in enumerate(labels):
        for label in np.unique(present):
            showing.setdefault(int(label), []).append(frame)
    if not showing:
        raise ValueError(f"class-balanced resampling: none of the {len(labels)} frames shows an object")
    share = sum(map(len, showing.values())) // len(showing)
    return np.concatenate(
        [np.random.default_rng([seed, _TAG, label]).choice(showing[label], share) for label in sorted(showing)]
    )
