"""Frames of two sets in turn."""

import dataclasses

from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames


@dataclasses.dataclass(frozen=True)
class MixedFrames(WrappedFrames):
    """The frames of one set, except that every ``period``-th is the frame of the same index of another set.

    Everything else, such as the sensor and the names, is that of the first set.
    """

    frames: FrameSet
    other: FrameSet
    period: int

    def frame(self, index: int) -> Frame:
        return self._of(index).frame(index)

    def truth(self, index: int) -> Frame:
        return self._of(index).truth(index)

    labels = FrameSet.labels

    def fingerprint(self) -> str:
        return f"{self.frames.fingerprint()}, every {self.period}: {self.other.fingerprint()}"

    def _of(self, index: int) -> FrameSet:
        return self.frames if index % self.period else self.other
