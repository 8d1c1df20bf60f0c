"""Copy-paste augmentation: objects of other frames, at their original pose (paper, section 4; after SECOND)."""

import dataclasses
from collections.abc import Callable

import numpy as np

from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.footprints import footprints_overlap, points_in_boxes
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.objects import ObjectDatabase


@dataclasses.dataclass(frozen=True)
class Paste:
    """What to add to a frame, and what to take away."""

    points: np.ndarray
    """f32[q, c]: points of the pasted objects, one object behind another."""
    boxes: np.ndarray
    """f32[j, 9]."""
    labels: np.ndarray
    """i32[j]."""
    num_points: np.ndarray
    """i32[j]: points of the current sweep."""
    removed: np.ndarray
    """i64[p]: rows of the frame's points inside a pasted box, ascending."""

    @staticmethod
    def nothing(frame: Frame) -> "Paste":
        """No object for a frame."""
        none = np.zeros(0, np.int32)
        return Paste(frame.points[:0], frame.boxes[:0], none, none, none)


MakePaste = Callable[[Frame, np.random.Generator], Paste]


def make_paste(objects: ObjectDatabase, config: CopyPasteConfig, *, current_only: bool) -> MakePaste:
    """How to choose the objects for a frame.

    In the order of the classes, as many objects are drawn as the class has too few of, counting the frame's boxes
    with at least one point, without replacement. A drawn object that overlaps any box of the frame, or an object
    pasted before, is left out and not replaced by another.

    Args:
        objects: to draw from: those with ``min_points`` points to paste, at least one of the current sweep.
        config: counts.
        current_only: paste the points with lag 0 alone, for models of a single sweep.

    Returns:
        ``(frame, rng) -> Paste``; the same frame and generator give the same objects.

    Raises:
        ValueError: the database was cut with a higher ``min_points`` than the configuration asks for.
    """
    least = objects.manifest.min_points
    if config.min_points < least:
        raise ValueError(
            f"copy_paste.min_points: got {config.min_points}, expected at least the object database's {least}"
        )
    table = objects.table
    pasted = table["current"] if current_only else table["count"]
    usable = (pasted >= config.min_points) & (table["current"] >= 1)
    pools = [np.flatnonzero(usable & (table["label"] == label)) for label in range(len(config.targets))]

    def paste(frame: Frame, rng: np.random.Generator) -> Paste:
        if len(objects) and frame.points.shape[1] != objects.manifest.columns:
            raise ValueError(
                f"{objects.folder}: got points of {objects.manifest.columns} columns, expected "
                f"{frame.points.shape[1]} as in the frames"
            )
        present = np.bincount(frame.labels[frame.num_points >= 1], minlength=len(pools))
        missing = np.maximum(np.array(config.targets) - present[: len(pools)], 0)
        drawn = [
            rng.choice(pool, min(count, len(pool)), replace=False)
            for pool, count in zip(pools, missing, strict=True)
            if count and len(pool)
        ]
        candidates = np.concatenate([np.zeros(0, np.int64), *drawn])
        chosen = candidates[_free(table["box"][candidates], frame.boxes)]
        boxes = table["box"][chosen]
        clouds = [np.zeros((0, frame.points.shape[1]), np.float32), *map(objects.points, chosen)]
        points = np.concatenate(clouds)
        if current_only:
            points = points[points[:, 4] == 0]
        inside = np.zeros(len(frame.points), bool)
        for rows in points_in_boxes(frame.points, boxes):
            inside[rows] = True
        return Paste(points, boxes, table["label"][chosen], table["current"][chosen], np.flatnonzero(inside))

    return paste


def _free(candidates: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Which candidates, taken one after another, overlap nothing present and none taken before, bool[k]."""
    free = np.asarray(~footprints_overlap(candidates, present).any(axis=1))
    clash = footprints_overlap(candidates, candidates)
    for i in range(len(free)):
        free[i] &= not (clash[i, :i] & free[:i]).any()
    return free
