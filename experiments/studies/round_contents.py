"""Contents of the extra rounds: what rounds 2 to 5 add to the first-round point of each cell.

    python -m experiments.studies.round_contents --data FOLDER --out experiments/results/round_contents.json

Compares each point of rounds 2 to 5 with the first-round point of its cell. Within 0.1 m it is the same spot
again; beyond 1 m it is another surface or, at grazing angles, the same surface farther on. Simulated frames are
varied streets around nuScenes' sensor. A cell belongs to the object whose box contains its first-round point, with
the box moved to the time of the point at constant velocity. Objects faster than 0.5 m/s are moving.
FOLDER/ten_sweep_cloud/ is a real cloud of ten sweeps without boxes. Shares are in percent, with 95 % bootstrap
intervals over the simulated frames. Cost: a few minutes of one CPU core.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.latency import fused_cloud, real_cloud
from experiments.paper_tables.scales import quarter
from experiments.script import Options, run_measurement
from experiments.statistics import bootstrap_weights, percent
from fcos_lidar_jax.data.box_geometry import points_in_boxes
from fcos_lidar_jax.data.frame import drop_close
from fcos_lidar_jax.progress import Progress
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, city_frames
from fcos_lidar_jax.simulation.lidar import SWEEP_S

ROUNDS = 5
READING = quarter(Path("unused")).base.reading  # Ten sweeps, without the trail of the bonnet.
GROUPS = ("background", "standing objects", "moving objects")
KINDS = ("within 0.1 m", "0.1 to 1 m", "beyond 1 m")
_EDGES_M = (0.1, 1.0)
MOVING_MPS = 0.5
_MIN_POINTS = 100  # Smaller rounds have no shares.

Counts = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the measurement."""

    frames: int = 40  # Simulated frames.
    seed: int = UNSEEN_SEED  # Seed of the first frame.
    data: Path | None = None
    """Folder with ten_sweep_cloud/; default: the environment's FCOS_LIDAR_REAL_DATA, else no real cloud."""


def boxes_when_seen(boxes: np.ndarray, lag_s: float) -> np.ndarray:
    """Move boxes f32[m, 9] back to the time at which a sweep saw them.

    A turn begins at azimuth pi, runs clockwise, and ends at the time of its sweep.
    """
    age_s = lag_s + SWEEP_S * (0.5 + np.arctan2(boxes[:, 1], boxes[:, 0]) / (2 * np.pi))
    return np.concatenate([boxes[:, :2] - age_s[:, None] * boxes[:, 7:9], boxes[:, 2:]], axis=1)


def find_owners(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Number of the box that contained each point when it was measured, i64[n]; -1 for the background.

    The last of several boxes counts.
    """
    owner = np.full(len(points), -1)
    for lag_s in np.unique(points[:, 4]):
        rows = np.flatnonzero(points[:, 4] == lag_s)
        for number, inside in enumerate(points_in_boxes(points[rows], boxes_when_seen(boxes, lag_s))):
            owner[rows[inside]] = number
    return owner


def contents(points: np.ndarray, boxes: np.ndarray) -> Counts:
    """Project a cloud f32[n, 5] and compare the later rounds with the first; boxes f32[m, 9] are current.

    Returns:
        by group of the first-round point: ``cells``, and of these ``history``, in which a later point is of the
        same object and older; by group and round: later points by ``kinds``, and sum of their ``age_s``; and
        ``objects``, the moving ones with a cell, with a cell with history, and with points of the current and an
        older sweep in the first round.
    """
    image = project_points(points, np.ones(len(points), bool), SENSOR, num_rounds=ROUNDS)
    index = np.asarray(image.point_index).reshape(-1, ROUNDS)
    index = index[index[:, 0] >= 0]
    first, later, there = index[:, 0], index[:, 1:], index[:, 1:] >= 0
    distance_m = np.linalg.norm(points[later, :3] - points[first, None, :3], axis=2)
    kind = np.digitize(distance_m, _EDGES_M)[..., None] == np.arange(len(KINDS))
    age_s, first_age_s = points[later, 4], points[first, 4]
    owner, moving = find_owners(points, boxes), np.hypot(boxes[:, 7], boxes[:, 8]) > MOVING_MPS
    older = there & (age_s > first_age_s[:, None])
    history = (owner[first] >= 0) & (older & (owner[later] == owner[first, None])).any(axis=1)
    values = {"cells": np.ones(len(first), int), "history": history}
    values |= {"kinds": there[..., None] & kind, "age_s": np.where(there, age_s, 0)}
    group = np.append(1 + moving, 0)[owner[first]]
    sums = {name: np.array([v[group == g].sum(axis=0) for g in range(len(GROUPS))]) for name, v in values.items()}
    now, before, remembered = (
        np.isin(np.flatnonzero(moving), owner[first[cells]])
        for cells in (first_age_s == 0, first_age_s > 0, history)
    )
    return sums | {"objects": np.array([(now | before).sum(), remembered.sum(), (now & before).sum()])}


def summarize(frames: Sequence[Counts], groups: Sequence[str] = GROUPS) -> dict[str, Any]:
    """Compute shares over all frames, by group; intervals if there are several frames."""
    weights = bootstrap_weights(len(frames))
    sums = {name: np.tensordot(weights, np.array([f[name] for f in frames]), 1) for name in frames[0]}
    objects, older, two_sweeps = sums.pop("objects").T
    record: dict[str, Any] = {
        "frames": len(frames),
        "all": _shares({name: v.sum(axis=1) for name, v in sums.items()}),
    }
    for g, group in enumerate(groups):
        record[group] = _shares({name: v[:, g] for name, v in sums.items()}, of_objects=g > 0)
    if groups:
        own = {"older in a later round": older, "two sweeps in the first round": two_sweeps}
        own = {name: percent(part, objects) for name, part in own.items()}
        record["each moving object"] = {"objects": int(objects[0]), **own}
    return record


def _shares(sums: Counts, *, of_objects: bool = False) -> dict[str, Any]:
    cells = sums["cells"]
    record: dict[str, Any] = {"cells": int(cells[0])}
    record |= {"older in a later round": percent(sums["history"], cells)} if of_objects else {}
    for r in range(ROUNDS - 1):
        kinds, number = sums["kinds"][:, r], sums["kinds"][:, r].sum(axis=1)
        own: dict[str, Any] = {"filled": percent(number, cells)}
        record[f"round {r + 2}"] = own
        if number[0] >= _MIN_POINTS:
            own |= {name: percent(kinds[:, k], number) for k, name in enumerate(KINDS)}
            own["mean age, s"] = round(float(sums["age_s"][0, r] / number[0]), 3)
    return record


def measure(args: Args) -> dict[str, Any]:
    """Count in simulated frames and the real cloud, of ten sweeps and of the current one."""
    if args.frames < 1:
        raise ValueError(f"--frames: got {args.frames}, expected at least 1")
    real = real_cloud(args.data)
    made = dataclasses.replace(city_frames(SENSOR, args.frames, args.seed), reading=READING)
    ten, one, progress = list[Counts](), list[Counts](), Progress("frames", args.frames)
    for i in range(args.frames):
        frame = made.frame(i)
        ten.append(contents(frame.points, frame.boxes))
        one.append(contents(frame.points[frame.points[:, 4] == 0], frame.boxes))
        progress.show(i + 1)
    record = {"seed": args.seed, "simulated, ten sweeps": summarize(ten), "simulated, one sweep": summarize(one)}
    if real:
        cloud, no_boxes = drop_close(fused_cloud(args.data, SENSOR)[0], SENSOR, READING)[0], np.zeros((0, 9))
        record["real, ten sweeps"] = summarize([contents(cloud, no_boxes)], ())
        record["real, one sweep"] = summarize([contents(cloud[cloud[:, 4] == 0], no_boxes)], ())
    return record


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
