"""How fast is the simulated world? Milliseconds of the processor for one HDL-32E sweep, and files a second.

    python -m experiments.benchmarks.synthesis_speed

Draws scenes of full length (40 keyframes), casts sweeps spread over them with and without a rolling shutter, and
writes a small data set in the official layout with one process. The processor's time counts, on one core.

Cost: under a minute, and 50 MB. Expected: at most 20 ms a sweep without a rolling shutter.
"""

import dataclasses
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from experiments.script import Options, run_measurement
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.lidar import SWEEP_S, sample_mount, scan
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import SWEEPS_PER_KEYFRAME, DatasetSpec, sample_scene


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to time."""

    scenes: int = 6  # Scenes of full length.
    sweeps: int = 20  # Sweeps cast in each.


def _cast_ms(spec: DatasetSpec, sweeps: int) -> dict[str, float]:
    drawing, casting = [], []
    for index in range(spec.scenes):
        rng = np.random.default_rng([spec.seed, index])
        began = time.process_time()
        world = sample_scene(rng, spec)
        drawing.append(time.process_time() - began)
        mount = sample_mount(rng, spec.sensor)
        for moment in np.linspace(0, (spec.keyframes - 1) * SWEEPS_PER_KEYFRAME * SWEEP_S, sweeps):
            began = time.process_time()
            scan(world, spec.sensor, mount, moment, rng, rolling_shutter=spec.rolling_shutter)
            casting.append(time.process_time() - began)
    return {
        "sweep_ms_median": round(1e3 * statistics.median(casting), 2),
        "sweep_ms_mean": round(1e3 * statistics.mean(casting), 2),
        "draw_scene_ms": round(1e3 * statistics.mean(drawing), 1),
    }


def written_per_s(spec: DatasetSpec) -> dict[str, float]:
    """Sweeps a second of a whole data set, tables and files included, with one process."""
    with tempfile.TemporaryDirectory() as root:
        wall, cpu = time.perf_counter(), time.process_time()
        write_dataset(spec, Path(root), workers=1, report=lambda done: None)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    sweeps = spec.scenes * ((spec.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1)
    return {"sweeps": sweeps, "per_cpu_s": round(sweeps / cpu, 1), "per_wall_s": round(sweeps / wall, 1)}


def measure(args: Args) -> dict[str, Any]:
    """Cast and write, without and with a rolling shutter."""
    spec = DatasetSpec(args.scenes, 0, 40, NUSCENES_HDL32E, False, "v1.0-synthetic")
    specs = {"": spec, ", rolling shutter": dataclasses.replace(spec, rolling_shutter=True)}
    _cast_ms(dataclasses.replace(spec, scenes=1), 3)  # warm up
    cast = {f"cast{kind}": _cast_ms(spec, args.sweeps) for kind, spec in specs.items()}
    few = {kind: dataclasses.replace(spec, scenes=2, keyframes=5) for kind, spec in specs.items()}
    return cast | {f"write{kind}": written_per_s(spec) for kind, spec in few.items()}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
