"""What does the training loop cost over the bare step?

    python experiments/loop_overhead.py

Trains the quickstart preset on simulated frames that are made beforehand, in turn with the bare compiled step on
one batch, and with the whole run's loop: batches from the loader, metrics read and recorded, progress. Prints the
medians of both and the time spent waiting for data. Expected: less than 3 % more. Two minutes on two cores.
"""

import dataclasses
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import tyro
from hardware import hardware

from fcos_lidar_jax.config import QUICKSTART
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.pipeline import make_batches
from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.training import fit, make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.training.records import Records
from fcos_lidar_jax.training.sharding import jit_step, make_mesh, replicate, shard_batch

CONFIG = dataclasses.replace(QUICKSTART, copy_paste=None, class_balanced=False)


@dataclasses.dataclass(frozen=True)
class Args:
    """How long, and where the figures go."""

    rounds: int = 8
    """Turns of both."""
    steps: int = 10
    """A turn."""
    result: Path = Path("outputs/loop_overhead.json")
    """JSON file."""


@dataclasses.dataclass(frozen=True)
class ReadyFrames:
    """Frames in memory: what is measured is the loop, not the simulation."""

    frames: tuple[Frame, ...]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        """One of them."""
        return self.frames[index]

    def labels(self, index: int) -> Any:
        """Of its boxes."""
        return self.frames[index].labels

    def name(self, index: int) -> str:
        """Its number."""
        return str(index)


def main(args: Args) -> None:
    """Measure in turn, print, and write the figures."""
    simulated = SimulatedFrames(TINY, 16)
    frames = ReadyFrames(tuple(simulated.frame(i) for i in range(len(simulated))))
    total = args.rounds * args.steps + 1
    mesh, detector, optimizer = make_mesh(), build_detector(CONFIG, TINY), make_optimizer(CONFIG.optimizer, total)
    step = jit_step(make_train_step(detector, CONFIG, TINY, optimizer), mesh)
    key = jax.random.key(0)
    start = make_state(detector.init(key), optimizer, key)
    bare, state = replicate(start, mesh), replicate(start, mesh)
    seconds: dict[str, list[float]] = {"bare": [], "loop": []}
    records: list[Record] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        make_batches(frames, CONFIG, seed=0, num_steps=total, threads=2) as batches,
    ):
        sharded = (dataclasses.replace(b, batch=shard_batch(b.batch, mesh)) for b in batches)
        kept = Records(Path(folder), first_step=0)
        first = next(sharded)
        bare, _ = step(bare, first.batch)  # compiles
        state, _ = step(state, first.batch)

        def report(number: int, record: Record) -> None:
            kept.write(number, record)
            records.append(record)

        for _ in range(args.rounds):
            began = time.perf_counter()
            for _ in range(args.steps):
                bare, _ = step(bare, first.batch)
            jax.block_until_ready(bare)
            seconds["bare"].append((time.perf_counter() - began) / args.steps)
            began, until = time.perf_counter(), int(state.step) + args.steps
            state = fit(step, state, sharded, num_steps=until, report=report)
            jax.block_until_ready(state)
            seconds["loop"].append((time.perf_counter() - began) / args.steps)
        kept.close()
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    result = {
        "command": "python experiments/loop_overhead.py",
        "milliseconds_a_step": {name: round(1000 * value, 2) for name, value in medians.items()},
        "loop_over_bare": round(medians["loop"] / medians["bare"], 4),
        "milliseconds_waiting_for_data": round(
            1000 * statistics.mean(float(r["waiting_seconds"]) for r in records),  # type: ignore[arg-type]
            2,
        ),
        "each": {name: [round(v, 4) for v in values] for name, values in seconds.items()},
        **hardware(),
    }
    print(json.dumps(result, indent=1))
    write_beside(args.result, lambda path: path.write_text(json.dumps(result, indent=1) + "\n"))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
