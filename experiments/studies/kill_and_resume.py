"""Does a run that is killed and resumed end where the run that was left alone ends, to the bit?

    python -m experiments.studies.kill_and_resume

A small detector is trained on simulated frames, saving after every step. Each of the runs is killed with SIGKILL
at a random moment, every third one as soon as a checkpoint is being written, and resumed, with another number of
threads. Expected: the same hash of parameters, statistics, optimizer state and running mean for all. About twenty
seconds a run on two cores, after a minute for the first.
"""

import dataclasses
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.script import run_script, save

STEPS = 8


@dataclasses.dataclass(frozen=True)
class Args:
    """How often, and where to."""

    runs: int = 20
    """Runs that are killed."""
    out: Path = Path("outputs/kill_and_resume.json")
    """Where the figures go."""


def train_and_hash(folder: str, threads: int) -> None:
    """Begin the run, or resume it, and write the hash of its last state into its folder."""
    import jax
    import numpy as np

    from experiments.studies.device_equivalence import CONFIG, SENSOR
    from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
    from fcos_lidar_jax.trainer import Schedule, train
    from fcos_lidar_jax.trainer.run import RUN_SPEC

    out, optimizer = Path(folder), dataclasses.replace(CONFIG.optimizer, batch_size=2)
    config = dataclasses.replace(CONFIG, copy_paste=None, class_balanced=False, optimizer=optimizer)
    state = train(
        config,
        SimulatedFrames(SENSOR, 12),
        out,
        steps=STEPS,
        resume=(out / RUN_SPEC).exists(),
        schedule=Schedule(save_every=1, evaluate_every=STEPS),
        threads=threads,
    )
    whole = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves((state.params, state.batch_stats, state.opt_state, state.ema)):
        whole.update(np.asarray(leaf).tobytes())
    steps = [json.loads(line)["step"] for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert steps == list(range(1, STEPS + 1)), steps
    (out / "hash.txt").write_text(whole.hexdigest())


def start(folder: Path, threads: int, cache: Path) -> subprocess.Popen[bytes]:
    """A process that trains."""
    cached = {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    work = f"from {__spec__.name} import train_and_hash; train_and_hash({str(folder)!r}, {threads})"
    with (folder.parent / f"{folder.name}.log").open("ab") as log:
        return subprocess.Popen([sys.executable, "-c", work], env=cached | os.environ, stdout=log, stderr=log)


def finish(folder: Path, threads: int, cache: Path) -> str:
    """Train to the end and say where it ended."""
    process = start(folder, threads, cache)
    if process.wait() != 0:
        raise RuntimeError((folder.parent / f"{folder.name}.log").read_text()[-3000:])
    return (folder / "hash.txt").read_text()


def kill(folder: Path, cache: Path, *, in_save: bool, chance: random.Random) -> dict[str, object]:
    """Start a run and kill it: while it saves, or at a random moment after its first steps."""
    process = start(folder, 1, cache)
    checkpoints = folder / "checkpoints"
    wanted = chance.randrange(1, STEPS - 1)
    until = time.monotonic() + 300

    def saved() -> list[int]:
        return sorted(int(path.name) for path in checkpoints.glob("[0-9]*"))

    while process.poll() is None and time.monotonic() < until:
        if saved()[-1:] >= [wanted] and not in_save:
            time.sleep(chance.uniform(0, 0.3))
            break
        if saved()[-1:] >= [wanted] and list(checkpoints.glob(".*")):
            break
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()
    newest = saved()[-1] if saved() else None
    return {"newest_checkpoint": newest, "unfinished_checkpoints": len(list(checkpoints.glob(".*")))}


def main(args: Args) -> None:
    """Kill, resume, compare."""
    chance = random.Random(0)
    with tempfile.TemporaryDirectory() as home:
        cache = Path(home) / "cache"
        expected = finish(Path(home) / "alone", 1, cache)
        runs = []
        for number in range(args.runs):
            folder = Path(home) / f"run{number}"
            killed = kill(folder, cache, in_save=number % 3 == 0, chance=chance)
            same = finish(folder, number % 3, cache) == expected
            runs.append({**killed, "same": same})
            print(f"run {number}: {runs[-1]}", flush=True)
            shutil.rmtree(folder)
    same = sum(run["same"] for run in runs)
    record = {
        "steps": STEPS,
        "runs": len(runs),
        "killed_while_saving": sum(run["unfinished_checkpoints"] > 0 for run in runs),
        "ended_the_same": same,
        "each": runs,
    }
    save(record, args.out, f"{same} of {len(runs)} ended in exactly the state of the run that was left alone")
    if same != len(runs):
        raise ValueError(f"got {len(runs) - same} runs that ended elsewhere, expected none")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
