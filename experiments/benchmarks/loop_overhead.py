"""What does a training run cost over the bare step?

    python -m experiments.benchmarks.loop_overhead

Trains the quickstart preset as ``fcos-lidar train`` does, on simulated frames that are made beforehand: batches
from the loader, metrics read and recorded, progress. After every turn of some steps the run waits, in a hook,
while the bare compiled step does as many on one batch. Prints the medians of both and the time spent waiting for
data. Expected: less than 3 % more. Two minutes on two cores.
"""

import dataclasses
import statistics
import tempfile
import time
from pathlib import Path

import jax

from experiments.script import run_script, save
from fcos_lidar_jax.data.frame import GivenFrames
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.trainer import Schedule, train
from fcos_lidar_jax.training import make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.training.sharding import jit_step, make_mesh, replicate, shard_batch

CONFIG = dataclasses.replace(QUICKSTART, copy_paste=None, class_balanced=False)


@dataclasses.dataclass(frozen=True)
class Args:
    """How long, and where the figures go."""

    rounds: int = 8
    """Turns of both."""
    steps: int = 10
    """A turn."""
    out: Path = Path("outputs/loop_overhead.json")
    """Where the figures go."""


def main(args: Args) -> None:
    """Measure in turn, print, and write the figures."""
    simulated = SimulatedFrames(TINY, 16)
    frames = tuple(simulated.frame(i) for i in range(len(simulated)))
    total = (args.rounds + 1) * args.steps
    mesh, detector, optimizer = make_mesh(), build_detector(CONFIG, TINY), make_optimizer(CONFIG.optimizer, total)
    step = jit_step(make_train_step(detector, optimizer), mesh)
    few = list(frames[: CONFIG.optimizer.batch_size])
    batch = shard_batch(make_batch(few, max_points=CONFIG.max_points, max_boxes=CONFIG.max_boxes), mesh)
    bare, _ = step(replicate(make_state(detector, optimizer, jax.random.key(0)), mesh), batch)  # compiles
    seconds: dict[str, list[float]] = {"bare": [], "loop": []}
    began = time.perf_counter()

    def take_turns(number: int, record: Record) -> None:
        nonlocal bare, began
        if number % args.steps:
            return
        jax.block_until_ready(jax.live_arrays())  # the next step of the run is under way
        middle = time.perf_counter()
        for _ in range(args.steps):
            bare, _ = step(bare, batch)
        jax.block_until_ready(bare)
        if number > args.steps:  # the first turn compiles
            seconds["loop"].append((middle - began) / args.steps)
            seconds["bare"].append((time.perf_counter() - middle) / args.steps)
        began = time.perf_counter()

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        given, never = GivenFrames(frames, TINY, simulated.classes), Schedule(total + 1, total + 1)
        train(CONFIG, given, folder, steps=total, hooks=(take_turns,), schedule=never)
        waited = [line["waiting_seconds"] for line in read_metrics(folder) if "waiting_seconds" in line]
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    record = {
        "milliseconds_a_step": {name: round(1000 * value, 2) for name, value in medians.items()},
        "loop_over_bare": round(medians["loop"] / medians["bare"], 4),
        "milliseconds_waiting_for_data": round(1000 * statistics.mean(waited), 2),
        "each": {name: [round(v, 4) for v in values] for name, values in seconds.items()},
    }
    save(record, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
