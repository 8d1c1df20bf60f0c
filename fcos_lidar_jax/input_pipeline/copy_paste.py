"""Copy-paste augmentation: objects of other frames, at their original pose (paper, section 4; after SECOND)."""

from collections.abc import Callable

import numpy as np

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.box_geometry import footprints_overlap, points_in_boxes
from fcos_lidar_jax.data.class_mapping import map_labels
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase

MakePaste = Callable[[Frame, np.random.Generator], tuple[Frame, np.ndarray]]


def make_paste(objects: GroundTruthDatabase, config: Config) -> MakePaste:
    """How to choose the objects for a frame.

    In the order of the classes, as many objects are drawn as the class has too few of, counting the frame's boxes
    with at least one point, without replacement. A drawn object that overlaps any box of the frame, or an object
    pasted before, is left out and not replaced by another.

    Args:
        objects: to draw from, classes matched by name: those with ``min_points`` points to paste, at least one of
            the current sweep.
        config: counts by class; a model of k sweeps gets the points of the newest k sweeps of an object's frame.

    Returns:
        ``(frame, rng) -> (pasted, removed)``: the objects, one behind another, their points of the current sweep
        counted, and i64[p], rows of the frame's points inside a pasted box, ascending. The frame's labels index
        ``config.classes``. The same frame and generator give the same objects.

    Raises:
        ValueError: the database has a higher ``min_points`` than the configuration, or shares no class with it.
    """
    assert config.copy_paste is not None
    targets, min_points, manifest = config.paste_targets, config.copy_paste.min_points, objects.manifest
    if min_points < manifest.min_points:
        raise ValueError(
            f"copy_paste.min_points: got {min_points}, expected at least the database's {manifest.min_points}"
        )
    of_class = map_labels(manifest.classes, config.classes)
    if (of_class < 0).all():
        found, wanted = ", ".join(manifest.classes), ", ".join(config.classes)
        raise ValueError(f"{objects.folder}: classes: got {found}, expected some of {wanted}")
    boxes, labels = objects.table["box"], of_class[objects.table["label"]]
    current, pasted = objects.num_points(1), objects.num_points(config.num_sweeps)
    usable = (pasted >= min_points) & (current >= 1)
    pools = [np.flatnonzero(usable & (labels == label)) for label in range(len(targets))]

    def paste(frame: Frame, rng: np.random.Generator) -> tuple[Frame, np.ndarray]:
        if len(objects) and frame.points.shape[1] != manifest.columns:
            raise ValueError(
                f"{objects.folder}: got points of {manifest.columns} columns, expected "
                f"{frame.points.shape[1]} as in the frames"
            )
        present = np.bincount(frame.labels[frame.num_points >= 1], minlength=len(pools))
        missing = np.maximum(np.array(targets) - present, 0)
        drawn = [
            rng.choice(pool, min(count, len(pool)), replace=False)
            for pool, count in zip(pools, missing, strict=True)
            if count and len(pool)
        ]
        candidates = np.concatenate([np.zeros(0, np.int64), *drawn])
        chosen = candidates[_free(boxes[candidates], frame.boxes)]
        clouds = [objects.points(index)[: pasted[index]] for index in chosen]
        points = np.concatenate([frame.points[:0], *clouds])
        inside = np.zeros(len(frame.points), bool)
        for rows in points_in_boxes(frame.points, boxes[chosen]):
            inside[rows] = True
        return Frame(points, boxes[chosen], labels[chosen], current[chosen]), np.flatnonzero(inside)

    return paste


def _free(candidates: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Which candidates, taken one after another, overlap nothing present and none taken before, bool[k]."""
    free = np.asarray(~footprints_overlap(candidates[:, None], present).any(axis=1))
    clash = footprints_overlap(candidates[:, None], candidates)
    for i in range(len(free)):
        free[i] &= not (clash[i, :i] & free[:i]).any()
    return free
