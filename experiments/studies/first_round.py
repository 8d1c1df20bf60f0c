"""Candidates in the first round: the locations that can learn an object, by sweeps and priority.

    python -m experiments.studies.first_round --out experiments/results/first_round.json

A *candidate* of an object is a cell whose first-round point lies in the object's box: only candidates can become
positives in training. A cell is *left behind* by an object if its point was in the object's box when it was
measured, with the box moved back at constant velocity, and is outside the current box. Counts both in varied
streets around nuScenes' sensor, for ten sweeps, ten sweeps without priority, and one sweep. The objects have at
least one point of the current sweep within the limits of the range image. Objects faster than 0.5 m/s are
moving. Shares are in percent, with 95 % bootstrap intervals over the frames. Cost: two minutes of one CPU core.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.script import Options, run_measurement
from experiments.statistics import bootstrap_weights, percent
from experiments.studies.round_contents import MOVING_MPS, READING, SENSOR, find_owners
from fcos_lidar_jax.assignment import owners
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.projection import image_cells, project_points
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, city_frames

GROUPS = ("standing objects", "moving objects")
SETTINGS: dict[str, dict[str, bool]] = {
    "ten sweeps": {},
    "ten sweeps, without priority": {"prioritize_current": False},
    "one sweep": {"only_current": True},
}

Counts = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the measurement."""

    frames: int = 40  # Simulated frames.
    seed: int = UNSEEN_SEED  # Seed of the first frame.


def cells_of_objects(
    points: np.ndarray, boxes: np.ndarray, *, prioritize_current: bool = True, only_current: bool = False
) -> Counts:
    """Count the candidates and the cells left behind of each object in the first round.

    Args:
        points: f32[n, 5]: x, y, z, intensity, time lag.
        boxes: f32[m, 9], current.
        prioritize_current: points of the current sweep win against older ones.
        only_current: points of older sweeps are left out.

    Returns:
        ``candidates`` and ``left behind`` of each object, i64[m].
    """
    valid = points[:, 4] == 0 if only_current else np.ones(len(points), bool)
    image = project_points(points, valid, SENSOR, num_rounds=1, prioritize_current=prioritize_current)
    index = np.asarray(image.point_index)
    first = points[index[index >= 0]]
    now, then = _owners_now(first, boxes), find_owners(first, boxes)
    counted = {"candidates": now, "left behind": then[then != now]}
    return {name: np.bincount(owner[owner >= 0], minlength=len(boxes)) for name, owner in counted.items()}


def in_image(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Find the boxes with a point of the current sweep within the limits of the range image, bool[m]."""
    cells = np.asarray(image_cells(points, points[:, 4] == 0, SENSOR)[0])
    inside = points[cells < SENSOR.num_rows * SENSOR.num_columns]
    return np.isin(np.arange(len(boxes)), _owners_now(inside, boxes))


def _owners_now(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    return np.asarray(owners(points[:, :3], np.ones(len(points), bool), boxes, np.ones(len(boxes), bool)))


def summarize(frames: Sequence[tuple[np.ndarray, Counts]]) -> dict[str, Any]:
    """Compute shares and means over all objects, from ``moving`` bool[m] and the counts of each frame."""
    record, weights = dict[str, Any](), bootstrap_weights(len(frames))
    for group, moving in zip(GROUPS, (False, True), strict=True):
        candidates, behind = (
            [counts[name][m == moving] for m, counts in frames] for name in ("candidates", "left behind")
        )
        objects = weights @ [len(v) for v in candidates]
        cells, left = (weights @ [v.sum() for v in values] for values in (candidates, behind))
        record[group] = {
            "objects": int(objects[0]),
            "without candidates": percent(weights @ [(v == 0).sum() for v in candidates], objects),
            "candidates, median": float(np.median(np.concatenate(candidates))) if objects[0] else None,
            "candidates, mean": round(float(cells[0] / max(objects[0], 1)), 1),
            "left behind, of these and the candidates": percent(left, cells + left),
        }
    return record


def measure(args: Args) -> dict[str, Any]:
    """Count in simulated frames."""
    if args.frames < 1:
        raise ValueError(f"--frames: got {args.frames}, expected at least 1")
    made = dataclasses.replace(city_frames(SENSOR, args.frames, args.seed), reading=READING)
    found: dict[str, list[tuple[np.ndarray, Counts]]] = {name: [] for name in SETTINGS}
    progress = Progress("frames", args.frames)
    for i in range(args.frames):
        frame = made.frame(i)
        boxes = frame.boxes[in_image(frame.points, frame.boxes)]
        moving = np.hypot(boxes[:, 7], boxes[:, 8]) > MOVING_MPS
        for name, options in SETTINGS.items():
            found[name].append((moving, cells_of_objects(frame.points, boxes, **options)))
        progress.show(i + 1)
    return {"seed": args.seed, "frames": args.frames, **{name: summarize(f) for name, f in found.items()}}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
