"""How fast is the loader, and what stops it? Ten-sweep samples with copy-paste, by stage and in all.

    python -m experiments.benchmarks.loader_speed --data-root ROOT --version V --split S

Reads a data set in nuScenes' layout (``fcos-lidar synthesize`` makes one; by default the real scene-0523 below the
environment's ``FCOS_LIDAR_REAL_DATA``), cuts a ground-truth database from it into a temporary folder, and times
one sample's way on one thread: reading its sweep files, fusing them, choosing objects and removing what they hide,
filling the padded batch. Then whole batches, prepared on demand, by two threads, and by two processes; and a
training step of the quickstart preset, to be compared with. Everything is read once before, so files come from the
page cache; ``read_from_disk_ms`` is with the cache dropped.

Times of other programs on the same cores lengthen the wall clock, not the processor time, which is printed too:
with the cores to itself a loader makes about cores / (processor time a sample) samples a second.

Cost: two minutes. Expected on two cores: at least 40 samples a second. The paper's eight GPUs need 52.8: 40 epochs
of 123,580 samples, class-balanced resampling counted, in 26 hours.
"""

import dataclasses
import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.script import real_data, run_script, save
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.input_pipeline.batching import empty_batch, fill_row, make_batch
from fcos_lidar_jax.input_pipeline.copy_paste import make_paste
from fcos_lidar_jax.input_pipeline.database import GroundTruthDatabase, prepare_database
from fcos_lidar_jax.input_pipeline.loader import make_batches
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import NUSCENES, QUICKSTART
from fcos_lidar_jax.sensors import load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step

EPOCHS, EPOCH_SAMPLES, HOURS = 40, 123_580, 26
"""The paper's training on 8 A100: an epoch of nuScenes' 28,130 training frames after class-balanced resampling."""

FULL_SIZE = Path("experiments/results/full_size.json")
"""Has the time of a training step of the paper's preset."""

WAYS = {
    "on demand": {"threads": 0, "workers": 0},
    "2 threads": {"threads": 2, "workers": 0},
    "2 processes": {"threads": 0, "workers": 2},
}
"""Of preparing batches."""


@dataclasses.dataclass(frozen=True)
class Args:
    """What to load."""

    data_root: Path | None = None
    """Data set in nuScenes' layout; default: nuscenes_scene0523 below FCOS_LIDAR_REAL_DATA."""
    version: str = "v1.0-scene0523"
    """Folder of the tables."""
    split: str = "scene0523"
    """Keyframes to load."""
    batch_size: int = 8
    """Samples a batch."""
    samples: int = 160
    """To load in each way of preparing batches."""
    repeats: int = 15
    """Samples timed for the stages; the median counts."""
    train_step: bool = True
    """Time a training step of the quickstart preset too."""
    out: Path = Path("outputs/loader_speed.json")
    """Where the figures go."""


def median_ms(
    action: Callable[[int], object], repeats: int, clock: Callable[[], float] = time.thread_time
) -> float:
    """Median time of ``action(0)``, ``action(1)``, ..., in milliseconds; of the processor by default."""
    times = []
    for i in range(repeats):
        began = clock()
        action(i)
        times.append(1e3 * (clock() - began))
    return round(statistics.median(times), 2)


def read(files: list[Path]) -> None:
    """Read the sweeps of one sample."""
    for file in files:
        np.fromfile(file, np.float32)


def read_from_disk_s(files: list[Path]) -> float:
    """Wall clock of reading files that are not in the page cache."""
    for file in files:
        with file.open("rb") as stream:
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    began = time.perf_counter()
    read(files)
    return time.perf_counter() - began


def fill(config: Config, frames: list[Frame], pasted: list[tuple[Frame, np.ndarray]]) -> None:
    """Write samples into a new batch, as the pipeline does."""
    batch = empty_batch(len(frames), max_points=config.max_points, max_boxes=config.max_boxes, columns=5)
    for row, (frame, (extra, removed)) in enumerate(zip(frames, pasted, strict=True)):
        fill_row(batch, row, [frame, extra], removed)


def stages(frames: NuScenesFrames, objects: GroundTruthDatabase, config: Config, repeats: int) -> dict[str, Any]:
    """Milliseconds of the processor for every stage of a sample, on one thread."""
    assert config.copy_paste is not None
    paste = make_paste(objects, config)
    # Late frames have all their sweeps, and neighbours stay apart.
    indices = np.linspace(len(frames) // 2, len(frames) - 1, repeats).astype(int)
    root, index = frames.nuscenes.root, frames.nuscenes.index
    files = sorted(root / name.decode() for name in index.sweep_file)[-config.num_sweeps :]
    loaded = [frames.frame(int(i)) for i in indices]
    pasted = [paste(frame, np.random.default_rng(int(i))) for i, frame in zip(indices, loaded, strict=True)]
    reading = median_ms(lambda _: read(files), repeats)
    whole = median_ms(lambda i: frames.frame(int(indices[i])), repeats)
    batch_ms = median_ms(lambda _: fill(config, loaded, pasted), 5)
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
            "fill the batch": round(batch_ms / len(loaded), 2),
        },
        "read_from_disk_ms": round(1e3 * statistics.median(read_from_disk_s(files) for _ in range(5)), 1),
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
    threads: int,
    workers: int,
) -> dict[str, float]:
    """Samples a second, once it runs; as much waits ready at the end as at the beginning."""
    size = config.optimizer.batch_size
    steps, warm = -(-samples // size), 6
    truncated = {"truncated_points": 0, "truncated_boxes": 0}
    more = 10 * (warm + steps)
    with make_batches(
        frames, config, seed=0, num_steps=more, objects=objects, threads=threads, workers=workers
    ) as batches:
        for _ in range(warm):
            next(batches)
        began, cpu = time.perf_counter(), cpu_s()
        for _ in range(steps):
            counts = next(batches).counts
            truncated = {name: truncated[name] + counts[name] for name in truncated}
        wall, cpu = time.perf_counter() - began, cpu_s() - cpu
    return {
        "samples_per_s": round(steps * size / wall, 1),
        "cpu_ms_a_sample": round(1e3 * cpu / steps / size, 1),
        "cores_had": round(cpu / wall, 2),
        **truncated,
    }


def quickstart_step_s() -> float:
    """Wall clock of a training step of the quickstart preset, median of ten."""
    config, sensor = QUICKSTART, load_sensor(QUICKSTART.sensor)
    frames = [make_frame(seed, sensor) for seed in range(config.optimizer.batch_size)]
    batch = jax.device_put(make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes))
    detector, optimizer = build_detector(config, sensor), make_optimizer(config.optimizer, 100)
    state = make_state(detector, optimizer, jax.random.key(0))
    step = jax.jit(make_train_step(detector, optimizer))
    jax.block_until_ready(step(state, batch))
    return median_ms(lambda _: jax.block_until_ready(step(state, batch)), 10, time.perf_counter) / 1e3


def needs(train_step: bool) -> dict[str, float]:
    """Samples a second that training takes in."""
    full_size = json.loads(FULL_SIZE.read_text(encoding="utf-8"))
    found = {
        "nuscenes, here": round(1e3 / full_size["milliseconds"]["train step"], 3),  # a batch of one
        "nuscenes, the paper's 8 GPUs": round(EPOCHS * EPOCH_SAMPLES / (HOURS * 3600), 1),
    }
    if train_step:
        found["quickstart, here"] = round(QUICKSTART.optimizer.batch_size / quickstart_step_s(), 1)
    return found


def main(args: Args) -> None:
    """Time everything, print and save it."""
    root = args.data_root or real_data(None, "nuscenes_scene0523")
    if root is None:
        raise ValueError("--data-root: missing, expected a data set in nuScenes' layout")
    config = dataclasses.replace(
        NUSCENES, optimizer=dataclasses.replace(NUSCENES.optimizer, batch_size=args.batch_size)
    )
    nuscenes = NuScenes(root, args.version)
    frames = NuScenesFrames(nuscenes, tuple(nuscenes.split(args.split)), config.num_sweeps)
    record: dict[str, Any] = {
        "data": args.version,
        "load_before": round(os.getloadavg()[0], 1),
    }
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        objects = prepare_database(frames, folder)
        record["database"] = {
            "objects": len(objects),
            "cpu_ms_a_frame": round(1e3 * (time.process_time() - began) / len(frames), 1),
        }
        record |= stages(frames, objects, config, args.repeats)
        record["loader"] = {
            name: throughput(frames, config, objects, args.samples, **how) for name, how in WAYS.items()
        }
    record["needed_samples_per_s"] = needs(args.train_step)
    save(record, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
