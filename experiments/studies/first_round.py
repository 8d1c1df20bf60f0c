"""Objects in the first round: what priority and older sweeps change for the locations that predict boxes.

    python -m experiments.studies.first_round --out experiments/results/first_round.json

A location learns to predict an object only if its first-round point lies in the object's box. Such a cell is a
*candidate*; an object without candidates is learned as background. A cell is *left behind* by an object if its
point was in the object's box when it was measured and is outside the current box. Counts both kinds of cells in
varied streets around nuScenes' sensor, for ten sweeps, ten sweeps without priority, and one sweep. All objects
have points of the current sweep; those faster than 0.5 m/s are moving. Shares are in percent, with 95 %
bootstrap intervals over the frames. Cost: two minutes of one CPU core.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.script import Options, run_measurement
from experiments.studies.round_contents import MOVING_MPS, READING, SENSOR, find_owners, percent, resampling
from fcos_lidar_jax.data.box_geometry import points_in_boxes
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, city_frames

GROUPS = ("standing objects", "moving objects")
SETTINGS = {"ten sweeps": True, "ten sweeps, without priority": False, "one sweep": True}
"""Setting -> priority of the current sweep."""

Counts = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the measurement."""

    frames: int = 40  # Simulated frames.
    seed: int = UNSEEN_SEED  # Seed of the first frame.


def cells_of_objects(points: np.ndarray, boxes: np.ndarray, *, prioritize_current: bool = True) -> Counts:
    """Count the candidates and the cells left behind of each object.

    Args:
        points: f32[n, 5]: x, y, z, intensity, time lag.
        boxes: f32[m, 9], current.
        prioritize_current: whether points of the current sweep win against older ones.

    Returns:
        i64[m] each.
    """
    options = {"num_rounds": 1, "prioritize_current": prioritize_current}
    index = np.asarray(project_points(points, np.ones(len(points), bool), SENSOR, **options).point_index)
    first = points[index[index >= 0]]
    owner, inside = find_owners(first, boxes), points_in_boxes(first, boxes)
    return {
        "candidates": np.array([len(rows) for rows in inside], int),
        "left behind": np.array([(np.delete(owner, rows) == i).sum() for i, rows in enumerate(inside)], int),
    }


def summarize(frames: Sequence[tuple[np.ndarray, Counts]]) -> dict[str, Any]:
    """Compute shares and means over all objects, from ``moving`` bool[m] and the counts of each frame."""
    record, weights = dict[str, Any](), resampling(len(frames))
    for group, moving in zip(GROUPS, (False, True), strict=True):
        values = {name: [counts[name][m == moving] for m, counts in frames] for name in frames[0][1]}
        objects = weights @ [len(v) for v in values["candidates"]]
        missing = weights @ [(v == 0).sum() for v in values["candidates"]]
        cells, behind = (weights @ [v.sum() for v in values[name]] for name in ("candidates", "left behind"))
        record[group] = {
            "objects": int(objects[0]),
            "without candidates": percent(missing, objects),
            "candidates per object": round(float(cells[0] / max(objects[0], 1)), 1),
            "left behind": percent(behind, cells + behind),
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
        moving = np.hypot(frame.boxes[:, 7], frame.boxes[:, 8]) > MOVING_MPS
        for name, prioritize in SETTINGS.items():
            points = frame.points[frame.points[:, 4] == 0] if name == "one sweep" else frame.points
            found[name].append((moving, cells_of_objects(points, frame.boxes, prioritize_current=prioritize)))
        progress.show(i + 1)
    return {"seed": args.seed, "frames": args.frames, **{name: summarize(f) for name, f in found.items()}}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
