"""Tracking of boxes by the distance between their centres."""

import dataclasses

import numpy as np

MAX_DISTANCE_M = 2.0  # maximum distance between a box and the expected position of its track
MAX_UNSEEN_S = 2.0  # a track without boxes ends after this time
_CLOCK_S = 0.05  # tolerance of the times of sweeps


@dataclasses.dataclass(frozen=True)
class Tracks:
    """Tracked objects in a static coordinate frame; empty by default."""

    ids: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))  # i64[t]
    labels: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int32))  # i32[t]
    centres: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))  # f64[t, 2]: x, y, metres
    velocities: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))  # f64[t, 2]: m/s
    unseen_s: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))  # f64[t]: since the last box
    next_id: int = 0


def track(
    tracks: Tracks,
    boxes: np.ndarray,
    labels: np.ndarray,
    scores: np.ndarray,
    dt: float,
) -> tuple[Tracks, np.ndarray]:
    """Match boxes greedily to tracks of their class, nearest pairs first, regardless of the order of the boxes.

    The position of a track is extrapolated by its velocity, and a track ends :data:`MAX_UNSEEN_S` after its last
    box. Unmatched boxes start new tracks, by decreasing score.

    Args:
        tracks: tracks of the previous time.
        boxes: f32[m, 9], ``x, y, z, l, w, h, yaw, vx, vy`` in a static coordinate frame;
            unknown (NaN) velocities count as 0.
        labels, scores: i32[m], f32[m].
        dt: seconds since the previous time.

    Returns:
        the new tracks, and the track number of every box, i64[m], starting at 0.

    >>> car = np.array([[10.0, 0, 0, 4, 2, 1.5, 0, 8, 0]])
    >>> tracks, ids = track(Tracks(), car, np.zeros(1, int), np.ones(1), 0.0)
    >>> moved = car + [[4.0, 0, 0, 0, 0, 0, 0, 0, 0]]
    >>> ids.tolist(), track(tracks, moved, np.zeros(1, int), np.ones(1), 0.5)[1].tolist()
    ([0], [0])
    """
    alive = tracks.unseen_s + dt <= MAX_UNSEEN_S + _CLOCK_S
    fields = tracks.ids, tracks.labels, tracks.centres, tracks.velocities, tracks.unseen_s
    tracks = Tracks(*(field[alive] for field in fields), next_id=tracks.next_id)
    order = np.lexsort((*boxes.T, labels, -scores))
    boxes, labels = np.asarray(boxes, np.float64)[order], labels[order]
    expected = tracks.centres + dt * tracks.velocities
    distance = np.linalg.norm(boxes[:, None, :2] - expected, axis=-1)
    distance[labels[:, None] != tracks.labels] = np.inf
    ids, free = np.full(len(boxes), -1), np.ones(len(expected), bool)
    near = np.flatnonzero(distance <= MAX_DISTANCE_M)
    for pair in near[np.argsort(distance.flat[near], kind="stable")]:
        box, old = divmod(int(pair), len(expected))
        if ids[box] < 0 and free[old]:
            ids[box], free[old] = tracks.ids[old], False
    new = ids < 0
    ids[new] = tracks.next_id + np.arange(new.sum())
    after = Tracks(
        np.concatenate([ids, tracks.ids[free]]),
        np.concatenate([labels, tracks.labels[free]]),
        np.concatenate([boxes[:, :2], expected[free]]),
        np.concatenate([np.nan_to_num(boxes[:, 7:9]), tracks.velocities[free]]),
        np.concatenate([np.zeros(len(boxes)), tracks.unseen_s[free] + dt]),
        tracks.next_id + int(new.sum()),
    )
    return after, ids[np.argsort(order)]
