"""What does a training run cost over the bare step?

    python -m experiments.benchmarks.loop_overhead

Trains the quickstart preset as ``fcos-lidar train`` does, on simulated frames that are made beforehand. After
every turn of some steps the run waits, in a hook, while the bare compiled step does as many on one batch. Prints
the medians of both and the time spent waiting for data. Expected: less than 3 % more. Two minutes on two cores.
"""

import dataclasses
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks.training_steps import training_steps
from experiments.script import Options, run_measurement
from fcos_lidar_jax.data.frame import InMemoryFrames
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.training.metrics_log import read_metrics

CONFIG = dataclasses.replace(QUICKSTART, copy_paste=None, class_balanced=False)


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How long."""

    rounds: int = 8  # Turns of both.
    steps: int = 10  # A turn.


def measure(args: Args) -> dict[str, Any]:
    """Time the run and the bare step in turn."""
    simulated = SimulatedFrames(TINY, 16)
    frames = tuple(simulated.frame(i) for i in range(len(simulated)))
    total = (args.rounds + 1) * args.steps
    step = training_steps(CONFIG, TINY, frames[: CONFIG.optimizer.batch_size])
    step()  # compiles
    seconds: dict[str, list[float]] = {"bare": [], "loop": []}
    began = time.perf_counter()

    def take_turns(number: int, record: Record) -> None:
        nonlocal began
        if number % args.steps:
            return
        jax.block_until_ready(jax.live_arrays())  # the next step of the run is under way
        middle = time.perf_counter()
        jax.block_until_ready([step() for _ in range(args.steps)])
        if number > args.steps:  # the first turn compiles
            seconds["loop"].append((middle - began) / args.steps)
            seconds["bare"].append((time.perf_counter() - middle) / args.steps)
        began = time.perf_counter()

    with tempfile.TemporaryDirectory() as temporary:
        given, never = InMemoryFrames(frames, TINY, simulated.classes), Schedule(total + 1, total + 1)
        device = jax.devices()[:1]
        train(CONFIG, given, temporary, steps=total, hooks=(take_turns,), schedule=never, devices=device)
        records = read_metrics(Path(temporary))
    waited = [line["waiting_seconds"] for line in records if "waiting_seconds" in line]
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    return {
        "milliseconds_a_step": {name: round(1000 * value, 2) for name, value in medians.items()},
        "loop_over_bare": round(medians["loop"] / medians["bare"], 4),
        "milliseconds_waiting_for_data": round(1000 * statistics.mean(waited), 2),
        "each": {name: [round(v, 4) for v in values] for name, values in seconds.items()},
    }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
