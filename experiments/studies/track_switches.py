"""How often does an object change its identity, with predicted velocities and without?

    python -m experiments.studies.track_switches --out experiments/results/track_switches.json

Simulated drives of ordinary traffic, at keyframes or at every sweep. The tracker of ``stream --track`` gets the
objects that at least one point shows: as they are, or with the errors of a detector, normal ones of centre and
velocity and boxes that are missed. An object switches where it was seen before under another identity. A tracking
metric it is not: there are no false boxes, and labels are right. Cost: three minutes on two CPU cores.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.script import Options, run_measurement
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.inference.tracks import Tracks, track
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import boxes_in_sensor_frame
from fcos_lidar_jax.simulation.lidar import SWEEP_S, sample_mount, scan, sensor_pose
from fcos_lidar_jax.simulation.render import SWEEPS_PER_KEYFRAME, DatasetSpec, sample_scene

Seen = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Boxes f64[m, 9] in the street's frame, labels i32[m], which objects they are i64[m]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """How many drives, and how a detector errs in them."""

    scenes: int = 8  # Drives.
    keyframes: int = 11  # Of a drive, half a second apart.
    seed: int = 77  # Of drives and errors.
    centre_m: float = 0.2  # Deviation of a detected centre, each way.
    velocity_mps: float = 0.5  # Of a velocity, each way.
    missed: float = 0.2  # Share of the boxes that are not found.


def drive(spec: DatasetSpec, index: int) -> list[Seen]:
    """What points show at every sweep of a drive."""
    rng = np.random.default_rng([spec.seed, index])
    world, seen = sample_scene(rng, spec), []
    mount = sample_mount(rng, spec.sensor, streets=spec.streets)
    for number in range(spec.sweeps):
        sweep = scan(world, spec.sensor, mount, number * SWEEP_S, rng)
        pose = sensor_pose(world, mount, number * SWEEP_S)
        points = sweep.points[sweep.returned, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        boxes = boxes_in_sensor_frame(world, np.eye(4), number * SWEEP_S)
        shown = np.flatnonzero(count_inside(points, boxes))
        seen.append((boxes[shown], world.traffic.labels[shown], shown))
    return seen


def with_errors(seen: Seen, rng: np.random.Generator, args: Args) -> Seen:
    """What a detector might find of it."""
    found = rng.random(len(seen[0])) >= args.missed
    boxes, labels, objects = (column[found] for column in seen)
    boxes[:, :2] += rng.normal(0, args.centre_m, (len(boxes), 2))
    boxes[:, 7:9] += rng.normal(0, args.velocity_mps, (len(boxes), 2))
    return boxes, labels, objects


def count_switches(frames: Sequence[Seen], dt: float, *, velocities: bool) -> tuple[int, int]:
    """Identities that objects changed, and times that an object was seen again."""
    tracks, last, switches, again = Tracks(), dict[int, int](), 0, 0
    for number, (boxes, labels, objects) in enumerate(frames):
        if not velocities:
            boxes = boxes.copy()
            boxes[:, 7:9] = 0
        tracks, ids = track(tracks, boxes, labels, np.ones(len(boxes)), dt if number else 0.0)
        for thing, name in zip(objects.tolist(), ids.tolist(), strict=True):
            again += thing in last
            switches += last.get(thing, name) != name
            last[thing] = name
    return switches, again


def measure(args: Args) -> dict[str, Any]:
    """Count the switches of every drive."""
    spec = DatasetSpec(args.scenes, args.seed, args.keyframes, NUSCENES_HDL32E, False, "")
    rng, counts = np.random.default_rng(args.seed), dict[str, np.ndarray]()
    for index in range(args.scenes):
        sweeps = drive(spec, index)
        erring = [with_errors(seen, rng, args) for seen in sweeps]
        for rate, step in (("keyframes", SWEEPS_PER_KEYFRAME), ("sweeps", 1)):
            for what, frames in (("exact", sweeps), ("with errors", erring)):
                for velocities in (True, False):
                    name = f"{rate}, {what}, {'with' if velocities else 'without'} velocities"
                    counted = count_switches(frames[::step], step * SWEEP_S, velocities=velocities)
                    counts[name] = counts.get(name, 0) + np.array(counted)
    named = {name: {"switches": int(n), "seen_again": int(again)} for name, (n, again) in counts.items()}
    return {**{field.name: getattr(args, field.name) for field in dataclasses.fields(args)[1:]}, "counts": named}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
