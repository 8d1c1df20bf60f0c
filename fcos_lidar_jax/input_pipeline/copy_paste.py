"""Copy-paste augmentation: objects from other frames at their original pose (paper, section 4; after SECOND)."""

from collections.abc import Callable

import numpy as np

from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.box_geometry import footprints_overlap, points_in_boxes
from fcos_lidar_jax.data.class_mapping import map_labels
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase

Paste = Callable[[Frame, np.random.Generator], tuple[Frame, np.ndarray]]  # See :func:`make_paste`.


def make_paste(objects: GroundTruthDatabase, config: Config) -> Paste:
    """Make the function that samples objects for a frame.

    For each class in order, samples without replacement as many objects as the frame lacks, counting the frame's
    boxes with at least one point. An object that overlaps a box of the frame, also one that a class map left out,
    or an object pasted before is dropped and not replaced. Objects match by class name and need ``min_points``
    points to paste, at least one of them from the current sweep; a model of k sweeps gets the points of the newest
    k sweeps.

    Returns:
        ``(frame, rng) -> (pasted, removed)``: the objects, with their numbers of points of the current sweep, and
        i64[p], the ascending rows of the frame's points inside pasted boxes. The frame's labels index
        ``config.classes``. The result is deterministic in the frame and the generator.

    Raises:
        ValueError: the database has a higher ``min_points`` or fewer sweeps than the configuration, or shares no
            class with it.
    """
    assert config.copy_paste is not None
    targets, min_points, manifest = config.paste_targets, config.copy_paste.min_points, objects.manifest
    expected = f"at least the database's {manifest.min_points}"
    check(min_points >= manifest.min_points, "copy_paste.min_points", min_points, expected)
    of_class = map_labels(manifest.classes, config.classes)
    if (of_class < 0).all():
        got, expected = ", ".join(manifest.classes), ", ".join(config.classes)
        raise ValueError(f"{objects.folder}: classes: got {got}, expected some of {expected}")
    sweeps = config.num_sweeps
    expected = (
        f"at most the {manifest.num_sweeps} of {objects.folder}: run fcos-lidar prepare --num-sweeps {sweeps}"
    )
    check(sweeps <= manifest.num_sweeps, "num_sweeps", sweeps, expected)
    boxes, labels = objects.table["box"], of_class[objects.table["label"]]
    current, pasted = objects.num_points(1), objects.num_points(sweeps)
    usable = (pasted >= min_points) & (current >= 1)
    pools = [np.flatnonzero(usable & (labels == label)) for label in range(len(targets))]

    def paste(frame: Frame, rng: np.random.Generator) -> tuple[Frame, np.ndarray]:
        counts = np.bincount(frame.labels[frame.num_points != 0], minlength=len(pools))
        missing = np.maximum(np.array(targets) - counts, 0)
        sampled = [
            rng.choice(pool, min(count, len(pool)), replace=False)
            for pool, count in zip(pools, missing, strict=True)
            if count and len(pool)
        ]
        candidates = np.concatenate([np.zeros(0, np.int64), *sampled])
        present = np.concatenate([frame.boxes, frame.others])
        rows = candidates[_without_overlap(boxes[candidates], present)]
        columns = frame.points.shape[1]  # a sensor without rows of lasers has no use for their numbers
        clouds = [objects.points(row)[: pasted[row], :columns] for row in rows]
        points = np.concatenate([frame.points[:0], *clouds])
        inside = np.zeros(len(frame.points), bool)
        for covered in points_in_boxes(frame.points, boxes[rows]):
            inside[covered] = True
        return Frame(points, boxes[rows], labels[rows], current[rows]), np.flatnonzero(inside)

    return paste


def _without_overlap(candidates: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Which candidates, accepted in order, overlap neither present boxes nor accepted candidates, bool[k]."""
    free = np.asarray(~footprints_overlap(candidates[:, None], present).any(axis=1))
    clash = footprints_overlap(candidates[:, None], candidates)
    for i in range(len(free)):
        free[i] &= not (clash[i, :i] & free[:i]).any()
    return free
