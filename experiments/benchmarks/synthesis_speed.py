"""How fast is the simulated world? Milliseconds of the processor for one HDL-32E sweep, and files a second.

    python -m experiments.benchmarks.synthesis_speed

Draws scenes of full length (40 keyframes), casts sweeps spread over them with and without a rolling shutter, and
writes a small data set in the official layout with one process. The processor's time counts, on one core, so
that other work on the machine does not.

Cost: under a minute, and 50 MB that are removed at the end. Expected: at most 20 ms a sweep without a rolling
shutter.
"""

import dataclasses
import os
import statistics
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from experiments.script import run_script, save
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.lidar import SWEEP_S, sample_mount, scan
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import SWEEPS_PER_KEYFRAME, DatasetSpec, sample_scene


@dataclasses.dataclass(frozen=True)
class Args:
    """What to time, and where the answers go."""

    scenes: int = 6
    """Scenes of full length."""
    sweeps: int = 20
    """Sweeps cast in each."""
    folder: Path | None = None
    """For a small data set, removed at the end; by default that of temporary files."""
    out: Path = Path("outputs/synthesis_speed.json")
    """Where the figures go."""


def cast_ms(order: DatasetSpec, sweeps: int) -> dict[str, float]:
    """Processor milliseconds a sweep, and for drawing a scene."""
    drawing, casting = [], []
    for index in range(order.scenes):
        rng = np.random.default_rng([order.seed, index])
        began = time.process_time()
        world = sample_scene(rng, order)
        drawing.append(time.process_time() - began)
        mount = sample_mount(rng, order.sensor)
        for moment in np.linspace(0, (order.keyframes - 1) * SWEEPS_PER_KEYFRAME * SWEEP_S, sweeps):
            began = time.process_time()
            scan(world, order.sensor, mount, moment, rng, rolling_shutter=order.rolling_shutter)
            casting.append(time.process_time() - began)
    return {
        "sweep_ms_median": round(1e3 * statistics.median(casting), 2),
        "sweep_ms_mean": round(1e3 * statistics.mean(casting), 2),
        "draw_scene_ms": round(1e3 * statistics.mean(drawing), 1),
    }


def written_per_s(order: DatasetSpec, folder: Path | None) -> dict[str, float]:
    """Sweeps a second of a whole data set, tables and files included, with one process."""
    with tempfile.TemporaryDirectory(dir=folder) as root:
        wall, cpu = time.perf_counter(), time.process_time()
        write_dataset(order, Path(root), workers=1, report=lambda done: None)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    sweeps = order.scenes * ((order.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1)
    return {"sweeps": sweeps, "per_cpu_s": round(sweeps / cpu, 1), "per_wall_s": round(sweeps / wall, 1)}


def main(args: Args) -> None:
    """Measure and print."""
    order = DatasetSpec(args.scenes, 0, 40, NUSCENES_HDL32E, False, "v1.0-synthetic")
    rolling = dataclasses.replace(order, rolling_shutter=True)
    cast_ms(dataclasses.replace(order, scenes=1), 3)  # warm up
    result = {
        "cast": cast_ms(order, args.sweeps),
        "cast, rolling shutter": cast_ms(rolling, args.sweeps),
        "write": written_per_s(dataclasses.replace(order, scenes=2, keyframes=5), args.folder),
        "write, rolling shutter": written_per_s(dataclasses.replace(rolling, scenes=2, keyframes=5), args.folder),
    }
    save(result, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
