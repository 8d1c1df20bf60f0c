"""Speed of the loader for ten-sweep samples with copy-paste.

    python -m experiments.benchmarks.loader_speed --data-root ROOT --version V --split S

Reads a data set in nuScenes' layout (such as one written by ``fcos-lidar synthesize``; default: the real
scene-0523 below the environment's ``FCOS_LIDAR_REAL_DATA``), extracts a ground-truth database from it, and times
batches prepared on demand, by two threads, by two processes, and for a device (a CPU here) by two threads.
A training step of the quickstart preset is timed for comparison. Files come from the page cache. Other programs
increase the wall time but not the processor time: an undisturbed loader prepares about cores / (processor time per
sample) samples per second.

Cost: two minutes. Expected on two cores: at least 40 samples per second. The paper's eight GPUs need 52.8: 40
epochs of 123,580 samples after class-balanced resampling in 26 hours.
"""

import contextlib
import dataclasses
import functools
import json
import multiprocessing
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks.training_steps import training_steps
from experiments.changes import change
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.inference.timing import interleaved
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase, cut_reading, prepare_database
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.presets import NUSCENES, QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import HostBatch

EPOCHS, EPOCH_SAMPLES, HOURS = 40, 123_580, 26
"""The paper's training on 8 A100: an epoch of nuScenes' 28,130 training frames after class-balanced resampling."""
FULL_SIZE = Path("experiments/results/full_size.json")  # Has the time of a training step of the paper's preset.
WAYS = {"on demand": (0, 0), "2 threads": (2, 0), "2 processes": (0, 2)}
"""Ways of preparing batches: threads and worker processes."""
Batches = Iterator[HostBatch]


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    data_root: Path | None = None
    """Data set in nuScenes' layout; default: nuscenes_scene0523 below FCOS_LIDAR_REAL_DATA."""
    version: str = "v1.0-scene0523"  # Folder of the tables.
    split: str = "scene0523"  # Keyframes to load.
    batch_size: int = 8  # Samples per batch.
    samples: int = 160  # Samples per way of preparing batches.
    train_step: bool = True  # Also time a training step of the quickstart preset.


def cpu_s() -> float:
    """Sum the processor time of this process and its running children."""
    total = time.process_time()
    for child in multiprocessing.active_children():
        fields = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def throughput(
    frames: NuScenesFrames,
    config: Config,
    objects: GroundTruthDatabase,
    samples: int,
    *,
    delivery: Callable[[Batches], AbstractContextManager[Batches]] = contextlib.nullcontext,
    **how: Any,
) -> dict[str, float]:
    """Measure samples per second in a steady state, with as many prepared samples at the end as at the start."""
    size, warm = config.optimizer.batch_size, 6
    steps = -(-samples // size)
    truncated: Counter[str] = Counter(truncated_points=0, truncated_boxes=0)
    options: dict[str, Any] = {"seed": 0, "num_steps": 10 * (warm + steps), "objects": objects, **how}
    with make_batches(frames, config, **options) as prepared, delivery(prepared) as batches:
        for _ in range(warm - 1):
            next(batches)
        num_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(next(batches).batch))
        began, cpu = time.perf_counter(), cpu_s()
        for _ in range(steps):
            counts = next(batches).counts
            truncated.update({name: counts[name] for name in truncated})
        wall, cpu = time.perf_counter() - began, cpu_s() - cpu
    found = {"samples_per_s": round(steps * size / wall, 1), "cpu_ms_a_sample": round(1e3 * cpu / steps / size, 1)}
    return {**found, "cores_had": round(cpu / wall, 2), "bytes_a_batch": num_bytes, **truncated}


def _needs(train_step: bool) -> dict[str, float]:
    full_size = json.loads(FULL_SIZE.read_text(encoding="utf-8"))
    found = {
        "nuscenes, here": round(1e3 / full_size["milliseconds"]["train step"], 3),  # a batch of one
        "nuscenes, the paper's 8 GPUs": round(EPOCHS * EPOCH_SAMPLES / (HOURS * 3600), 1),
    }
    if train_step:
        size, sensor = QUICKSTART.optimizer.batch_size, load_sensor(QUICKSTART.sensor)
        step = training_steps(QUICKSTART, sensor, [make_frame(seed, sensor) for seed in range(size)])
        found["quickstart, here"] = round(1e3 * size / interleaved({"step": step}, 10)["step"]["median_ms"], 1)
    return found


def measure(args: Args) -> dict[str, Any]:
    """Time the loader in all ways, and the training steps that it serves."""
    root = args.data_root or find_real_data(None, "nuscenes_scene0523")
    if root is None:
        raise ValueError("--data-root: missing, expected a data set in nuScenes' layout")
    config = change(optimizer__batch_size=args.batch_size)(NUSCENES)
    nuscenes = NuScenes(root, args.version)
    frames = NuScenesFrames(nuscenes, tuple(nuscenes.split(args.split)), cut_reading(config.num_sweeps))
    record: dict[str, Any] = {"data": args.version, "load_before": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        objects = prepare_database(frames, folder)
        spent_ms = 1e3 * (time.process_time() - began)
        record["database"] = {"objects": len(objects), "cpu_ms_a_frame": round(spent_ms / len(frames), 1)}
        load = functools.partial(throughput, frames, config, objects, args.samples)
        record["loader"] = {name: load(threads=n, workers=m) for name, (n, m) in WAYS.items()}
        record["loader"]["on the device"] = load(
            threads=2,
            lend=True,
            delivery=functools.partial(feed, mesh=make_mesh(jax.devices()[:1])),
        )
    return {**record, "needed_samples_per_s": _needs(args.train_step)}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
