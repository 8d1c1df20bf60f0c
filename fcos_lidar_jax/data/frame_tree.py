"""Frames that stand and move in each other, as ROS's ``/tf_static`` and ``/tf`` tell."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fcos_lidar_jax.data.drives import PoseTrack
from fcos_lidar_jax.data.sweeps import find_bad_pose

_ODOM = "odom"  # the frame that does not jump, by ROS's REP 105; others above it may
_MAX_LISTED = 20  # frames in a message

PoseRow = tuple[float, ...]
"""A pose: the quaternion w, x, y, z and the translation in metres."""


def printable(text: str) -> str:
    """A text of a recording as a part of a line, of at most 500 characters.

    >>> printable("/points"), printable("a\\nb")
    ('/points', "'a\\\\nb'")
    """
    text = text if text.isprintable() else repr(text)
    return text if len(text) <= 500 else text[:500] + "..."


def make_track(times_us: Sequence[int], rows: Sequence[PoseRow], where: str) -> PoseTrack:
    """Poses at times that increase.

    Raises:
        ValueError: naming ``where`` and the pose: it cannot be one.
    """
    values = np.array(rows, np.float64).reshape(-1, 7)
    if bad := find_bad_pose(values[:, :4], values[:, 4:]):
        raise ValueError(f"{where}: pose {bad[0]}: {bad[1]}")
    return PoseTrack(np.array(times_us, np.int64), values[:, :4], values[:, 4:])


class FrameTree:
    """Transforms of a recording.

    Args:
        where: what to call it in messages.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._static = dict[tuple[str, str], PoseRow]()  # (child, parent)
        self._moving = defaultdict[tuple[str, str], dict[int, PoseRow]](dict)
        self._parents = defaultdict[str, set[str]](set)
        self._tracks = dict[tuple[str, str], PoseTrack]()

    def add(self, child: str, parent: str, time_us: int | None, pose: PoseRow) -> None:
        """The pose of a frame in another one, at a time or, without one, always."""
        self._parents[child].add(parent)
        if time_us is None:
            self._static[child, parent] = pose
        else:
            self._moving[child, parent].setdefault(time_us, pose)  # some are sent twice

    def between(self, to: str, frame: str, time_us: int, where: str) -> np.ndarray:
        """The pose f64[4, 4] of a frame in another one.

        Raises:
            ValueError: naming ``where``: they are not connected, or there is a gap in the transforms.
        """
        up = self._ancestors(frame, to)
        down = [to] if to in up else self._ancestors(to, frame)
        meet = next((name for name in up if name in down), None)
        if meet is None:
            known = ", ".join(printable(name) for name in sorted(self._parents)[:_MAX_LISTED]) or "none"
            raise ValueError(
                f"{where}: no transform from {printable(frame)!r} to {printable(to)!r} in the recording, expected "
                f"one in /tf_static or /tf, which have those of: {known}"
            )
        pose = self._climb(up[: up.index(meet) + 1], time_us, where)
        return np.linalg.inv(self._climb(down[: down.index(meet) + 1], time_us, where)) @ pose

    def to_world(self, frame: str, time_us: int, where: str) -> np.ndarray:
        """The pose f64[4, 4] of a frame in ``odom``, or in its last ancestor where none is called so.

        Raises:
            ValueError: naming ``where``: nothing moves in between, or there is a gap in the transforms.
        """
        up = self._ancestors(frame, _ODOM)
        if not any(edge in self._moving for edge in pairwise(up)):
            found = " -> ".join(map(printable, up))[:2000]
            raise ValueError(f"{where}: got the frames {found}, expected one that moves, by /tf")
        return self._climb(up, time_us, where)

    def _ancestors(self, frame: str, last: str) -> list[str]:
        """A frame, what it is in, and so on, not beyond the last."""
        found = [frame]
        while found[-1] != last and (parents := self._parents.get(found[-1])):
            parent, *others = sorted(parents)
            if others or parent in found:
                what = f"{len(parents)} parents" if others else "itself among those that it is in"
                raise ValueError(f"{self._where}: tf: frame {printable(found[-1])!r} has {what}, expected a tree")
            found.append(parent)
        return found

    def _climb(self, frames: list[str], time_us: int, where: str) -> np.ndarray:
        """The pose of the first of a chain of frames in the last."""
        pose = np.eye(4)
        for edge in pairwise(frames):
            if edge not in self._tracks:
                self._tracks[edge] = self._make_track(edge)
            track = self._tracks[edge]
            at = time_us if len(track.times_us) > 1 else int(track.times_us[0])
            pose = track.at(at, f"{where}: tf of {printable(edge[0])} in {printable(edge[1])}") @ pose
        return pose

    def _make_track(self, edge: tuple[str, str]) -> PoseTrack:
        """Poses of a frame in its parent; one where they never change, which needs no neighbours in time."""
        known = {0: self._static[edge]} if edge in self._static else self._moving[edge]
        times = sorted(known) if len(set(known.values())) > 1 else [min(known)]
        return make_track(times, [known[time] for time in times], f"{self._where}: tf of {printable(edge[0])}")
