"""How much faster is a training step on a CPU when its buffers lie in huge pages?

    python -m experiments.benchmarks.huge_pages

Twenty steps of preset ``compact`` on one simulated frame, in this process and in another whose environment asks
the C library for huge pages (``GLIBC_TUNABLES``, glibc 2.35 or newer on Linux), turn by turn. XLA takes the
buffers of a step from the system each time, and without huge pages a part of the step goes to mapping them, 4
KiB at a time. The gain is one of steps in a row: with one step a turn the process with huge pages was the slower
one.
Cost: four minutes on two CPU cores. Expected: less than 0.9 of the time where
``/sys/kernel/mm/transparent_hugepage/enabled`` says ``madvise``; no difference where it says ``always``.
"""

import dataclasses
import functools
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks.peers import turn_by_turn
from experiments.benchmarks.training_steps import training_steps
from experiments.script import Options, run_measurement
from fcos_lidar_jax.data.frame import without_close
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.presets import COMPACT
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frames import make_frame

VARIABLE, HUGE = "GLIBC_TUNABLES", "glibc.malloc.hugetlb=1"
_STEPS = 20  # In a row, as in training.
_POLICY = Path("/sys/kernel/mm/transparent_hugepage/enabled")


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How often."""

    repeats: int = 10  # Turns.


@functools.cache
def _step() -> Callable[[], Any]:
    frames = [without_close(make_frame(0, NUSCENES_HDL32E, num_objects=30), NUSCENES_HDL32E, cut_reading(1))]
    return training_steps(COMPACT, NUSCENES_HDL32E, frames)


def train() -> None:
    """The steps of a turn, each to its end."""
    for _ in range(_STEPS):
        jax.block_until_ready(_step()())


_WHOSE = {"plain": "ours", "huge_pages": "peer"}
FNS = {"train": train}  # what the other process runs


def measure(args: Args) -> dict[str, Any]:
    """Compare this process with another that has huge pages."""
    if VARIABLE in os.environ:
        raise ValueError(f"{VARIABLE}: set to {os.environ[VARIABLE]!r}, expected it unset: it is what is compared")
    times = turn_by_turn(train, args.repeats, peer=Path(__file__), name="train", environment={VARIABLE: HUGE})
    seconds = {f"{name}_s": round(times[whose] / _STEPS, 4) for name, whose in _WHOSE.items()}
    policy = _POLICY.read_text(encoding="utf-8").strip() if _POLICY.exists() else None
    where = {"policy": policy, "libc": " ".join(platform.libc_ver())}
    return {**seconds, "ratio": round(times["peer"] / times["ours"], 3), "repeats": args.repeats, **where}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
