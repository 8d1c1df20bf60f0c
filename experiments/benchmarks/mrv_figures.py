"""Points kept by the multi-round projection, and its time. Reproduces figures of the paper without training.

    python -m experiments.benchmarks.mrv_figures  # the cloud of FCOS_LIDAR_REAL_DATA, else a simulated one
    python -m experiments.benchmarks.mrv_figures --data FOLDER  # FOLDER/ten_sweep_cloud/cloud.f16.bin

Counts the points kept by 1, 3, 5 and 7 rounds with and without priority of the current sweep, and the points of
the current sweep among them, with and without the points on the vehicle. Times one sweep and ten in turns, as
ratios to one round, as in table 1. Cost: half a minute on two CPU cores. The paper (section 3.2): about 240K
points, of which one round keeps about 28K and five rounds more than 50 %; seven rounds are hardly slower than one
(0.76 and 0.66 ms).
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.benchmarks.latency import ROWS, fused_cloud, padded
from experiments.paper import PAPER
from experiments.script import Options, run_measurement
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.inference.timing import interleaved
from fcos_lidar_jax.projection import project_points, remove_close
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor

ROUNDS = (1, 3, 5, 7)


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    data: Path | None = None
    """Folder with ten_sweep_cloud/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated cloud."""
    repeats: int = 100  # Timed calls.


Close = Literal["all", "none"]


def kept_by_rounds(
    points: np.ndarray, sensor: Sensor, *, rounds: Sequence[int] = ROUNDS, close: Close = "all"
) -> dict[str, Any]:
    """Count the kept points of a fused cloud f32[n, c] by rounds, with and without priority of the current sweep.

    A point is current if its time lag is 0; ``close`` tells which points on the vehicle are removed.

    Returns:
        ``in_range`` and ``in_view``, points within the sensor's limits and, of those, in its field of view; for
        ``prioritized`` and ``not prioritized``, by rounds: ``kept``, ``percent`` of those in range, ``current`` of
        the kept.
    """
    valid = np.asarray(remove_close(points, np.ones(len(points), bool), sensor, CloudReading(remove_close=close)))
    (low, high), z = sensor.limit_z_m, points[:, 2]
    inside = (np.abs(points[:, :2]) < sensor.limit_xy_m).all(axis=1) & (z > low) & (z < high)
    in_range = int((inside & valid).sum())
    found: dict[str, Any] = {"in_range": in_range}
    for name, priority in (("prioritized", True), ("not prioritized", False)):
        image = project_points(points, valid, sensor, num_rounds=max(rounds), prioritize_current=priority)
        index = np.asarray(image.point_index).reshape(-1, max(rounds))
        current = (index >= 0) & (points[np.maximum(index, 0), 4] == 0)
        kept, newest = (index >= 0).sum(0).cumsum(), current.sum(0).cumsum()
        found["in_view"] = int(valid.sum()) - int(image.num_dropped)
        found[name] = {
            "kept": {str(r): int(kept[r - 1]) for r in rounds},
            "percent": {str(r): round(100 * float(kept[r - 1]) / max(in_range, 1), 2) for r in rounds},
            "current": {str(r): int(newest[r - 1]) for r in rounds},
        }
    return found


def mean_kept(clouds: Sequence[np.ndarray], sensor: Sensor) -> dict[str, Any]:
    """Average :func:`kept_by_rounds` over clouds."""
    found = [kept_by_rounds(cloud, sensor) for cloud in clouds]
    return jax.tree.map(lambda *numbers: round(float(np.mean(numbers)), 2), *found)


def mrv_times(
    cloud: np.ndarray, sensor: Sensor, *, rounds: Sequence[int] = ROUNDS, repeats: int = 100
) -> dict[str, Any]:
    """Time the projection of ten fused sweeps f32[n, 5] and of the current sweep, padded like the presets.

    Returns:
        ``{"single" | "multi": {rounds: {"median_ms", "p99_ms", "ratio"}}}``, the ratio to the first of ``rounds``.
    """
    calls = {}
    for setting in ROWS:
        ready = padded(cloud, setting, sensor)
        points, valid = jax.device_put((ready.points, ready.valid))
        for r in rounds:
            calls[setting, r] = functools.partial(project_points, points, valid, sensor, num_rounds=r)
    record: dict[str, Any] = {setting: {} for setting in ROWS}
    for (setting, r), own in (found := interleaved(calls, repeats)).items():
        ratio = round(own["median_ms"] / found[setting, rounds[0]]["median_ms"], 3)
        record[setting][str(r)] = {**own, "ratio": ratio}
    return record


def measure(args: Args) -> dict[str, Any]:
    """Measure counts and times, beside the times of table 1."""
    rows, sensor = PAPER["tables"]["table1"]["rows"], NUSCENES_HDL32E
    paper = {str(r): rows[f"multi, {r}"]["time_ms"] for r in ROUNDS}
    cloud, label = fused_cloud(args.data, sensor)
    close: dict[str, Close] = {"with": "none", "without": "all"}
    return {
        "cloud": label,
        "points": len(cloud),
        "kept": {
            f"{sweeps}, {which} close points": kept_by_rounds(points, sensor, close=removed)
            for sweeps, points in (("ten sweeps", cloud), ("one sweep", cloud[cloud[:, 4] == 0]))
            for which, removed in close.items()
        },
        "repeats": args.repeats,
        "times": mrv_times(cloud, sensor, repeats=args.repeats),
        "paper_times": {r: {"median_ms": ms, "ratio": round(ms / paper["1"], 3)} for r, ms in paper.items()},
    }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
