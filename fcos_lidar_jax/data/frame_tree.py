"""Static and moving coordinate frames, from ROS's ``/tf_static`` and ``/tf``."""

from collections import defaultdict
from itertools import pairwise

import numpy as np

from fcos_lidar_jax.data.drives import PoseRow, PoseTrack, make_track
from fcos_lidar_jax.fields import printable

_ODOM = "odom"  # by ROS's REP 105 it never jumps; frames above it may
_MAX_LISTED = 20  # frames listed in a message


class FrameTree:
    """Transforms of a recording, which messages call ``where``."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._static = dict[tuple[str, str], PoseRow]()  # (child, parent)
        self._moving = defaultdict[tuple[str, str], dict[int, PoseRow]](dict)
        self._parents = defaultdict[str, set[str]](set)
        self._tracks = dict[tuple[str, str], PoseTrack]()

    def add(self, child: str, parent: str, time_us: int | None, pose: PoseRow) -> None:
        """Add the pose of ``child`` in ``parent``; static if ``time_us`` is None."""
        self._parents[child].add(parent)
        if time_us is None:
            self._static[child, parent] = pose
        else:
            self._moving[child, parent].setdefault(time_us, pose)  # some transforms are sent twice

    def between(self, to: str, frame: str, time_us: int, where: str) -> np.ndarray:
        """The pose f64[4, 4] of ``frame`` in ``to``; refused, with ``where``, if they are not connected or have a
        gap.
        """
        up = self._ancestors(frame, to)
        down = [to] if to in up else self._ancestors(to, frame)
        meet = next((name for name in up if name in down), None)
        if meet is None:
            known = ", ".join(printable(name) for name in sorted(self._parents)[:_MAX_LISTED]) or "none"
            raise ValueError(
                f"{where}: no transform from {printable(frame)!r} to {printable(to)!r}, expected one in "
                f"/tf_static or /tf, which have transforms of: {known}"
            )
        pose = self._climb(up[: up.index(meet) + 1], time_us, where)
        return np.linalg.inv(self._climb(down[: down.index(meet) + 1], time_us, where)) @ pose

    def to_world(self, frame: str, time_us: int, where: str) -> np.ndarray:
        """The pose f64[4, 4] of a frame in ``odom``, or in its last ancestor if no ancestor has that name.

        Refused, with ``where``, if no transform on the way moves, or if the transforms have a gap.
        """
        up = self._ancestors(frame, _ODOM)
        if not any(edge in self._moving for edge in pairwise(up)):
            chain = " -> ".join(map(printable, up))[:2000]
            raise ValueError(f"{where}: got the frames {chain}, expected one that moves in /tf")
        return self._climb(up, time_us, where)

    def _ancestors(self, frame: str, last: str) -> list[str]:
        """The chain from a frame to its parents, up to ``last`` at most."""
        chain = [frame]
        while chain[-1] != last and (parents := self._parents.get(chain[-1])):
            parent, *others = sorted(parents)
            if others or parent in chain:
                problem = f"has {len(parents)} parents" if others else "is its own ancestor"
                raise ValueError(f"{self._where}: tf: frame {printable(chain[-1])!r} {problem}, expected a tree")
            chain.append(parent)
        return chain

    def _climb(self, frames: list[str], time_us: int, where: str) -> np.ndarray:
        """The pose of the first frame of a chain in the last one."""
        pose = np.eye(4)
        for edge in pairwise(frames):
            if edge not in self._tracks:
                self._tracks[edge] = self._make_track(edge)
            track = self._tracks[edge]
            at = time_us if len(track.times_us) > 1 else int(track.times_us[0])
            pose = track.at(at, f"{where}: tf of {printable(edge[0])} in {printable(edge[1])}") @ pose
        return pose

    def _make_track(self, edge: tuple[str, str]) -> PoseTrack:
        """Poses of a frame in its parent; a single pose, valid at all times, if it never changes."""
        known = {0: self._static[edge]} if edge in self._static else self._moving[edge]
        times = sorted(known) if len(set(known.values())) > 1 else [min(known)]
        where = f"{self._where}: tf of {printable(edge[0])}: pose"
        return make_track(times, [known[time] for time in times], lambda row: f"{where} {row}")
