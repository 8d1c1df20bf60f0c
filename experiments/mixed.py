"""Frames of two sets in turn."""

import dataclasses

from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames
from fcos_lidar_jax.fields import check


@dataclasses.dataclass(frozen=True)
class MixedFrames(WrappedFrames):
    """The frames of one set, except that every ``period``-th is the frame of the same index of another set.

    Names and everything else come from the first set.

    Raises:
        ValueError: the sets differ in length, sensor or classes.
    """

    frames: FrameSet
    other: FrameSet
    period: int

    def __post_init__(self) -> None:
        super().__post_init__()
        for field, own, others in (
            ("length", len(self.frames), len(self.other)),
            ("sensor", self.frames.sensor, self.other.sensor),
            ("classes", self.frames.classes, self.other.classes),
        ):
            check(own == others, f"other: {field}", others, f"that of the frames, {own!r}")

    def frame(self, index: int) -> Frame:
        return self._of(index).frame(index)

    def truth(self, index: int) -> Frame:
        return self._of(index).truth(index)

    labels = FrameSet.labels

    def fingerprint(self) -> str:
        return f"{self.frames.fingerprint()}, every {self.period}: {self.other.fingerprint()}"

    def _of(self, index: int) -> FrameSet:
        return self.frames if index % self.period else self.other
