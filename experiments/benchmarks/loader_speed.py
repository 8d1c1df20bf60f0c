"""How fast is the loader, and what stops it? Ten-sweep samples with copy-paste, by stage and in all.

    python -m experiments.benchmarks.loader_speed --data-root ROOT --version V --split S

Reads a data set in nuScenes' layout (``fcos-lidar synthesize`` makes one; by default the real scene-0523 below the
environment's ``FCOS_LIDAR_REAL_DATA``), cuts a ground-truth database from it, and times the stages of a sample on
one thread. Then whole batches, prepared on demand, by two threads, and by two processes; the paper's batches on
their way to a device, by turns plain from the main thread, as they once went, and packed in the background, as
GPUs are fed; and a training step of the quickstart preset, to be compared with. A CPU stands in for the device,
and a copy in its memory for the transfer. Files come from the page cache; ``read_from_disk_ms`` is without it.
Other programs lengthen the wall clock, not the processor time: with the cores to itself a loader makes about cores
/ (processor time a sample) samples a second.

Cost: four minutes. Expected on two cores: at least 40 samples a second, and 0.71 of the bytes. The paper's eight
GPUs need 52.8: 40 epochs of 123,580 samples, class-balanced resampling counted, in 26 hours.
"""

import contextlib
import dataclasses
import functools
import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from experiments.benchmarks.training_steps import training_steps
from experiments.changes import change
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import make_mesh, shard_batch
from fcos_lidar_jax.inference.timing import interleaved
from fcos_lidar_jax.input_pipeline.batching import empty_batch, fill_row
from fcos_lidar_jax.input_pipeline.copy_paste import make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase, cut_reading, prepare_database
from fcos_lidar_jax.input_pipeline.loader import make_batches, packing_for
from fcos_lidar_jax.presets import NUSCENES, QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.types import HostBatch

EPOCHS, EPOCH_SAMPLES, HOURS = 40, 123_580, 26
"""The paper's training on 8 A100: an epoch of nuScenes' 28,130 training frames after class-balanced resampling."""
FULL_SIZE = Path("experiments/results/full_size.json")  # Has the time of a training step of the paper's preset.
WAYS = {"on demand": (0, 0), "2 threads": (2, 0), "2 processes": (0, 2)}
"""Of preparing batches: threads, worker processes."""
Batches = Iterator[HostBatch]
Delivery = Callable[[Batches], AbstractContextManager[Batches]]
"""What brings prepared batches to where they are wanted."""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to load."""

    data_root: Path | None = None
    """Data set in nuScenes' layout; default: nuscenes_scene0523 below FCOS_LIDAR_REAL_DATA."""
    version: str = "v1.0-scene0523"  # Folder of the tables.
    split: str = "scene0523"  # Keyframes to load.
    batch_size: int = 8  # Samples a batch.
    samples: int = 160  # To load in each way of preparing batches.
    repeats: int = 15  # Samples timed for the stages; the median counts.
    feed_batch_size: int = 32  # Samples a batch on the way to the device.
    feed_turns: int = 5  # Turns of each way of feeding; the median counts.
    feed_samples: int = 160  # To bring to the device in a turn.
    train_step: bool = True  # Time a training step of the quickstart preset too.


def median_ms(action: Callable[[int], object], repeats: int) -> float:
    """Median time on the processor of ``action(0)``, ``action(1)``, ..., in milliseconds."""
    times = []
    for i in range(repeats):
        began = time.thread_time()
        action(i)
        times.append(1e3 * (time.thread_time() - began))
    return round(statistics.median(times), 2)


def read(files: list[Path], *, from_disk: bool = False) -> float:
    """Wall clock of reading the sweeps of one sample, from the page cache or not."""
    if from_disk:
        for file in files:
            with file.open("rb") as stream:
                os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    began = time.perf_counter()
    for file in files:
        np.fromfile(file, np.float32)
    return time.perf_counter() - began


def stages(frames: NuScenesFrames, objects: GroundTruthDatabase, config: Config, repeats: int) -> dict[str, Any]:
    """Milliseconds of the processor for every stage of a sample, on one thread."""
    paste = make_paste(objects, config)
    # Late frames have all their sweeps, and neighbours stay apart.
    indices = np.linspace(len(frames) // 2, len(frames) - 1, repeats).astype(int).tolist()
    root, index = frames.nuscenes.root, frames.nuscenes.index
    files = sorted(root / name.decode() for name in index.sweep_file)[-config.num_sweeps :]
    loaded = [frames.frame(i) for i in indices]
    pasted = [paste(frame, np.random.default_rng(i)) for i, frame in zip(indices, loaded, strict=True)]

    def fill() -> None:
        batch = empty_batch(len(loaded), max_points=config.max_points, max_boxes=config.max_boxes, columns=5)
        for row, (frame, (extra, removed)) in enumerate(zip(loaded, pasted, strict=True)):
            fill_row(batch, row, [frame, extra], removed)

    reading = median_ms(lambda _: read(files), repeats)
    whole = median_ms(lambda i: frames.frame(indices[i]), repeats)
    return {
        "sweep_bytes": round(statistics.mean(f.stat().st_size for f in files)),
        "points": round(statistics.mean(len(f.points) for f in loaded)),
        "pasted_objects": round(statistics.mean(len(p.boxes) for p, _ in pasted), 1),
        "pasted_points": round(statistics.mean(len(p.points) for p, _ in pasted)),
        "removed_points": round(statistics.mean(len(removed) for _, removed in pasted)),
        "stages_cpu_ms": {
            "read, page cache": reading,
            "filter, transform, fuse": round(whole - reading, 2),
            "copy-paste": median_ms(lambda i: paste(loaded[i], np.random.default_rng(i)), repeats),
            "fill the batch": round(median_ms(lambda _: fill(), 5) / len(loaded), 2),
        },
        "read_from_disk_ms": round(1e3 * statistics.median(read(files, from_disk=True) for _ in range(5)), 1),
    }


def cpu_s() -> float:
    """Processor time of this process and its living children."""
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
    delivery: Delivery = contextlib.nullcontext,
    **how: Any,
) -> dict[str, float]:
    """Samples a second, once it runs; as much waits ready at the end as at the beginning."""
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


@contextlib.contextmanager
def by_main_thread(batches: Batches, mesh: Mesh) -> Iterator[Batches]:
    """To the device when the next batch is asked for, and there when it is handed on."""
    yield (dataclasses.replace(b, batch=jax.block_until_ready(shard_batch(b.batch, mesh))) for b in batches)


def feeds(
    frames: NuScenesFrames, config: Config, objects: GroundTruthDatabase, *, turns: int, samples: int
) -> dict[str, Any]:
    """Bytes and samples a second that reach the device, in both ways by turns."""
    mesh = make_mesh(jax.devices()[:1])
    ways: dict[str, dict[str, Any]] = {
        "plain, main thread": {"delivery": functools.partial(by_main_thread, mesh=mesh)},
        "packed, background": {
            "delivery": functools.partial(feed, mesh=mesh),
            "packing": packing_for(frames, config),
        },
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for _ in range(turns):
        for name, how in ways.items():
            found[name].append(throughput(frames, config, objects, samples, threads=2, lend=True, **how))
    medians = {
        name: {key: statistics.median(turn[key] for turn in each) for key in each[0]}
        for name, each in found.items()
    }
    before, after = medians.values()
    ratios = {f"{key}_ratio": round(after[key] / before[key], 3) for key in ("samples_per_s", "bytes_a_batch")}
    return {"batch_size": config.optimizer.batch_size, **medians, **ratios}


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
    """Time the stages, the loader in all ways, and the steps that it has to feed."""
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
        record |= stages(frames, objects, config, args.repeats)
        load = functools.partial(throughput, frames, config, objects, args.samples)
        record["loader"] = {name: load(threads=n, workers=m) for name, (n, m) in WAYS.items()}
        large = change(optimizer__batch_size=args.feed_batch_size)(NUSCENES)
        record["feed"] = feeds(frames, large, objects, turns=args.feed_turns, samples=args.feed_samples)
    return {**record, "needed_samples_per_s": _needs(args.train_step)}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
