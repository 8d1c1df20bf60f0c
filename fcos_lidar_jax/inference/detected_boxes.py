"""The boxes that a detector finds in one cloud."""

import base64
import dataclasses
import html
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np

from fcos_lidar_jax.evaluation.records import SHOWN_SCORE, TrueBoxes
from fcos_lidar_jax.fields import check_name

_TABLE_ROWS = 20


class DetectedBox(NamedTuple):
    """One box."""

    name: str  # class
    score: float
    box: np.ndarray  # f32[9], see :mod:`fcos_lidar_jax.types`


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class DetectedBoxes:
    """The boxes in a cloud, best score first, in the frame of the points.

    They print as a table. Notebooks show a picture from above, with scores of at least 0.3.

    >>> box = np.array([[8, 0, 0, 4, 2, 1.5, 0, 3, 0]], np.float32)
    >>> found = DetectedBoxes(box, np.array([0.5]), np.array([1]), ("car", "bus"), np.zeros((0, 5)), {}, 50.0)
    >>> found
    1 box
    class  score       x       y       z      l      w      h    yaw     vx     vy
    bus     0.50    8.00    0.00    0.00   4.00   2.00   1.50   0.00   3.00   0.00
    >>> len(found), found[0].name, len(found[:5]), found.names.tolist(), found.select(min_score=0.6).valid.shape
    (1, 'bus', 1, ['bus'], (0,))
    """

    boxes: np.ndarray  # f32[m, 9]: x, y, z, l, w, h, yaw, vx, vy, see :mod:`fcos_lidar_jax.types`
    scores: np.ndarray  # f32[m]
    labels: np.ndarray  # i32[m], index into ``classes``
    classes: tuple[str, ...]  # of the detector
    points: np.ndarray  # f32[n, c], what the detector has seen of the cloud
    counts: dict[str, Any]  # numbers of points and the name of a point file, as in the JSON of ``detect``
    limit_m: float  # half the side of the square in which the detector finds objects

    @property
    def names(self) -> np.ndarray:
        """str[m]: classes of the boxes."""
        return np.array(self.classes)[self.labels]

    @property
    def valid(self) -> np.ndarray:
        """bool[m]: True, as there is no padding, for code that also takes the padded ``Detections``."""
        return np.ones(len(self), bool)

    def __len__(self) -> int:
        return len(self.boxes)

    @overload
    def __getitem__(self, index: int) -> DetectedBox: ...

    @overload
    def __getitem__(self, index: slice) -> "DetectedBoxes": ...

    def __getitem__(self, index: int | slice) -> "DetectedBox | DetectedBoxes":
        if isinstance(index, slice):
            return self._rows(index)
        return DetectedBox(self.classes[self.labels[index]], float(self.scores[index]), self.boxes[index])

    def __iter__(self) -> Iterator[DetectedBox]:
        return (self[index] for index in range(len(self)))

    def select(self, *, min_score: float = 0.0, labels: Collection[str] = ()) -> "DetectedBoxes":
        """Select boxes by score and class, by default of all classes; a ValueError names an unknown class."""
        kept = self.scores >= min_score
        labels = {labels} if isinstance(labels, str) else {*labels}
        for name in labels:
            check_name("labels", name, self.classes)
        if labels:
            kept &= np.isin(self.names, list(labels))
        return self._rows(kept)

    def _rows(self, rows: np.ndarray | slice) -> "DetectedBoxes":
        arrays = {name: getattr(self, name)[rows] for name in ("boxes", "scores", "labels")}
        return dataclasses.replace(self, **arrays)

    def to_dict(self) -> dict[str, Any]:
        """The boxes as ``fcos-lidar detect`` writes them: the entry of a file, without NumPy types."""
        boxes = [{"label": name, "score": score, "box": box.tolist()} for name, score, box in self]
        return {**self.counts, "boxes": boxes}

    def picture(self, *, min_score: float = SHOWN_SCORE, truth: TrueBoxes | None = None) -> bytes:
        """Draw the cloud and the boxes of at least ``min_score`` in bird's-eye view, and the truth dashed; returns
        the bytes of a PNG file.
        """
        from fcos_lidar_jax.visualization.bev import draw_bev

        shown = self.select(min_score=min_score)
        found = shown.boxes, shown.labels, shown.scores
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "boxes.png"
            draw_bev(self.points, file, limit_m=self.limit_m, classes=self.classes, detections=found, truth=truth)
            return file.read_bytes()

    def __repr__(self) -> str:
        width = max(5, *(len(self.classes[k]) for k in self.labels[:_TABLE_ROWS]), 0)
        sizes = dict.fromkeys("xyz", 7) | dict.fromkeys(("l", "w", "h", "yaw", "vx", "vy"), 6)
        lines = [
            f"{len(self)} box{'' if len(self) == 1 else 'es'}",
            f"{'class':{width}}  score " + " ".join(f"{name:>{size}}" for name, size in sizes.items()),
        ]
        for name, score, box in (self[i] for i in range(min(len(self), _TABLE_ROWS))):
            numbers = " ".join(f"{v:{size}.2f}" for v, size in zip(box, sizes.values(), strict=True))
            lines.append(f"{name:{width}}  {score:5.2f} {numbers}")
        rest = len(self) - _TABLE_ROWS
        return "\n".join(lines + [f"... and {rest} more"] * (rest > 0))

    def _repr_html_(self) -> str:
        data, shown = base64.b64encode(self.picture()).decode(), self.select(min_score=SHOWN_SCORE)
        title = f"Boxes of score {SHOWN_SCORE:g} and more, of {len(self)}"
        table = html.escape(repr(shown))
        return f'<p>{title}</p><img width="600" src="data:image/png;base64,{data}"><pre>{table}</pre>'
