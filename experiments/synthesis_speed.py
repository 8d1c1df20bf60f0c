"""How fast is the simulated world? Milliseconds of the processor for one HDL-32E sweep, and files a second.

    python experiments/synthesis_speed.py

Draws scenes of full length (40 keyframes), casts sweeps spread over them with and without a rolling shutter, and
writes a small data set in the official layout with one process. The processor's time counts, on one core, so
that other work on the machine does not.

Cost: under a minute and 50 MB below --out, removed at the end. Expected: at most 20 ms a sweep without a rolling
shutter.
"""

import dataclasses
import json
import os
import platform
import shutil
import statistics
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import tyro

from fcos_lidar_jax.data.synthetic.dataset import write_dataset
from fcos_lidar_jax.data.synthetic.lidar import SWEEP_S, draw_mount, scan
from fcos_lidar_jax.data.synthetic.render import SWEEPS_PER_KEYFRAME, Order, draw_scene
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.sensors import NUSCENES_HDL32E


@dataclasses.dataclass(frozen=True)
class Args:
    """What to time, and where the answers go."""

    scenes: int = 6
    """Scenes of full length."""
    sweeps: int = 20
    """Sweeps cast in each."""
    out: Path | None = None
    """Where the small data set is made for the while; by default a temporary folder."""
    result: Path = Path("experiments/results/synthesis_speed.json")
    """Where the figures go."""


def cast_ms(order: Order, sweeps: int) -> dict[str, float]:
    """Processor milliseconds a sweep, and for drawing a scene."""
    drawing, casting = [], []
    for index in range(order.scenes):
        rng = np.random.default_rng([order.seed, index])
        began = time.process_time()
        world = draw_scene(rng, order)
        drawing.append(time.process_time() - began)
        mount = draw_mount(rng, order.sensor)
        for moment in np.linspace(0, (order.keyframes - 1) * SWEEPS_PER_KEYFRAME * SWEEP_S, sweeps):
            began = time.process_time()
            scan(world, order.sensor, mount, moment, rng, rolling_shutter=order.rolling_shutter)
            casting.append(time.process_time() - began)
    return {
        "sweep_ms_median": round(1e3 * statistics.median(casting), 2),
        "sweep_ms_mean": round(1e3 * statistics.mean(casting), 2),
        "draw_scene_ms": round(1e3 * statistics.mean(drawing), 1),
    }


def written_per_s(order: Order, out: Path | None) -> dict[str, float]:
    """Sweeps a second of a whole data set, tables and files included, with one process."""
    root = Path(tempfile.mkdtemp(dir=out))
    try:
        wall, cpu = time.perf_counter(), time.process_time()
        write_dataset(order, root / "data", workers=1, report=lambda done: None)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    finally:
        shutil.rmtree(root)
    sweeps = order.scenes * ((order.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1)
    return {"sweeps": sweeps, "per_cpu_s": round(sweeps / cpu, 1), "per_wall_s": round(sweeps / wall, 1)}


def main(args: Args) -> None:
    """Measure and print."""
    order = Order(args.scenes, 0, 40, NUSCENES_HDL32E, False, "v1.0-synthetic")
    rolling = dataclasses.replace(order, rolling_shutter=True)
    cast_ms(dataclasses.replace(order, scenes=1), 3)  # warm up
    result = {
        "cast": cast_ms(order, args.sweeps),
        "cast, rolling shutter": cast_ms(rolling, args.sweeps),
        "write": written_per_s(dataclasses.replace(order, scenes=2, keyframes=5), args.out),
        "write, rolling shutter": written_per_s(dataclasses.replace(rolling, scenes=2, keyframes=5), args.out),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "cores": os.cpu_count(),
    }
    print(json.dumps(result, indent=1))
    write_beside(args.result, lambda path: path.write_text(json.dumps(result, indent=1) + "\n"))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
