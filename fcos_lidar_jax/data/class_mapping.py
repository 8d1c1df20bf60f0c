"""Mapping of classes by name, from a data set to a detector."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from fcos_lidar_jax.data.frame import Frame, FrameSet, WrappedFrames
from fcos_lidar_jax.files import checksum

ClassMap = Mapping[str, str | None]
"""Name in the data -> name to use instead; None drops the objects, unlisted names stay."""


def map_labels(of: Sequence[str], to: Sequence[str], class_map: ClassMap | None = None) -> np.ndarray:
    """i32[len(of)]: index into ``to`` of each class in ``of`` after the class map; -1 for dropped classes.

    A class map with a name that is not in ``of`` is refused.

    >>> map_labels(("Car", "Van", "Tram"), ("person", "car"), {"Car": "car", "Van": "car"}).tolist()
    [1, 1, -1]
    """
    class_map = class_map or {}
    if unknown := [name for name in class_map if name not in of]:
        raise ValueError(f"class map: got {', '.join(unknown)}, expected classes of the data: {', '.join(of)}")
    place = {name: i for i, name in enumerate(to)}
    names = (class_map.get(name, name) for name in of)
    return np.array([-1 if name is None else place.get(name, -1) for name in names], np.int32)


@dataclasses.dataclass(frozen=True)
class MappedFrames(WrappedFrames):
    """Frames with labels of other classes, mapped by name; boxes of other classes are left out.

    Raises:
        ValueError: at construction, if no name is shared.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    >>> frames = MappedFrames(SimulatedFrames(TINY, 3), ("person", "barrier"), {"pedestrian": "person"})
    >>> sorted(set(frames.labels(0).tolist())), sorted(frames.left_out())[:3]
    ([0, 1], ['bicycle', 'bus', 'car'])
    """

    frames: FrameSet
    target_classes: tuple[str, ...]
    class_map: ClassMap | None = None  # translates the names of the frames' classes first

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "classes", self.target_classes)
        if (self._table < 0).all():
            raise ValueError(
                f"classes: the data have {', '.join(self.frames.classes) or 'none'}, the detector "
                f"{', '.join(self.classes)}, expected a name in both: choose classes of the data, or translate "
                "their names by a class map"
            )

    @property
    def _table(self) -> np.ndarray:
        return map_labels(self.frames.classes, self.classes, self.class_map)

    def frame(self, index: int) -> Frame:
        return self._mapped(self.frames.frame(index))

    def truth(self, index: int) -> Frame:
        return self._mapped(self.frames.truth(index))

    def _mapped(self, frame: Frame) -> Frame:
        kept = (labels := self._table[frame.labels]) >= 0
        rows = {"boxes": frame.boxes[kept], "labels": labels[kept], "num_points": frame.num_points[kept]}
        return dataclasses.replace(frame, **rows, others=np.concatenate([frame.others, frame.boxes[~kept]]))

    def labels(self, index: int) -> np.ndarray:
        labels = self._table[self.frames.labels(index)]
        return labels[labels >= 0]

    def left_out(self) -> dict[str, int]:
        """Number of dropped boxes per class of the data; reads the labels of all frames."""
        counts = np.zeros(len(self.frames.classes), np.int64)
        for index in range(len(self.frames)):
            counts += np.bincount(self.frames.labels(index), minlength=len(counts))
        lost = (self._table < 0) & (counts > 0)
        return {self.frames.classes[i]: int(counts[i]) for i in np.flatnonzero(lost)}

    def fingerprint(self) -> str:
        """The wrapped frames' fingerprint if the classes stay the same, else a checksum of it and the mapping."""
        source = self.frames.fingerprint()
        if self.class_map is None and self.classes == self.frames.classes:
            return source
        return checksum(repr((source, self.classes, self._table.tolist())).encode())
