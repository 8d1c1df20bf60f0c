"""Does a run that is killed and resumed end where the run that was left alone ends, to the bit?

    python -m experiments.studies.kill_and_resume

A small detector is trained on simulated frames, saving after every step. Each of the runs is killed with SIGKILL
at a random moment, every third one while a checkpoint is being written, and resumed with another number of
threads. Expected: the same hash of all state. Twenty seconds a run on two cores, after a minute for the first.
"""

import dataclasses
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import tempfile
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax
import numpy as np

from experiments.changes import change
from experiments.script import Options, run_script, save
from experiments.studies.device_equivalence import CONFIG, SENSOR, draw_variables
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.trainer import Schedule, train
from fcos_lidar_jax.trainer.run import RUN_SPEC

STEPS = 8


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How often."""

    runs: int = 20  # Runs that are killed.


def train_and_hash(out: Path, threads: int) -> None:
    """Begin the run, or resume it, and write the hash of its last state into its folder."""
    config = change(copy_paste=None, class_balanced=False, optimizer__batch_size=2)(CONFIG)
    state = train(
        config,
        SimulatedFrames(SENSOR, 12),
        out,
        steps=STEPS,
        resume=(out / RUN_SPEC).exists(),
        weights=draw_variables(build_detector(config, SENSOR), "float32"),
        schedule=Schedule(save_every=1, evaluate_every=STEPS),
        threads=threads,
    )
    whole = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves((state.params, state.batch_stats, state.opt_state, state.ema)):
        whole.update(np.asarray(leaf).tobytes())
    steps = [json.loads(line)["step"] for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert steps == list(range(1, STEPS + 1)), steps
    (out / "hash.txt").write_text(whole.hexdigest())


def _start(folder: Path, threads: int) -> BaseProcess:
    process = multiprocessing.get_context("spawn").Process(target=train_and_hash, args=(folder, threads))
    process.start()
    return process


def _finish(folder: Path, threads: int) -> str:
    process = _start(folder, threads)
    process.join()
    if process.exitcode:
        raise RuntimeError(f"{folder.name}: ended with {process.exitcode}")
    return (folder / "hash.txt").read_text()


def kill(folder: Path, *, in_save: bool, chance: random.Random) -> dict[str, object]:
    """Start a run and kill it: while it saves, or at a random moment after its first steps."""
    process, checkpoints = _start(folder, 1), folder / "checkpoints"
    wanted, until = chance.randrange(1, STEPS - 1), time.monotonic() + 300

    def newest() -> int | None:
        return max((int(path.name) for path in checkpoints.glob("[0-9]*")), default=None)

    while process.is_alive() and time.monotonic() < until:
        if (newest() or 0) >= wanted and (not in_save or list(checkpoints.glob(".*"))):
            time.sleep(0 if in_save else chance.uniform(0, 0.3))
            break
        time.sleep(0.001)
    process.kill()
    process.join()
    return {"newest_checkpoint": newest(), "unfinished_checkpoints": len(list(checkpoints.glob(".*")))}


def main(args: Args) -> None:
    """Kill, resume, compare."""
    chance, runs = random.Random(0), []
    with tempfile.TemporaryDirectory() as home:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(home, "cache")))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        expected = _finish(Path(home, "alone"), 1)
        for number in range(args.runs):
            folder = Path(home, f"run{number}")
            killed = kill(folder, in_save=number % 3 == 0, chance=chance)
            runs.append({**killed, "same": _finish(folder, number % 3) == expected})
            print(f"run {number}: {runs[-1]}", flush=True)
            shutil.rmtree(folder)
    same, saving = sum(run["same"] for run in runs), sum(run["unfinished_checkpoints"] > 0 for run in runs)
    record = {"steps": STEPS, "runs": len(runs), "killed_while_saving": saving}
    record = {**record, "ended_the_same": same, "each": runs}
    save(record, args.out, f"{same} of {len(runs)} ended in exactly the state of the run that was left alone")
    if same != len(runs):
        raise ValueError(f"got {len(runs) - same} runs that ended elsewhere, expected none")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
