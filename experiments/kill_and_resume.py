"""Does a run that is killed and resumed end where the run that was left alone ends, to the bit?

    python experiments/kill_and_resume.py

A small detector is trained on simulated frames, saving after every step. Each of the runs is killed with SIGKILL
at a random moment, every third one as soon as a checkpoint is being written, and resumed, with another number of
threads. Expected: the same hash of parameters, statistics, optimizer state and running mean for all. About twenty
seconds a run on two cores, after a minute for the first.
"""

import argparse
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

from hardware import hardware

RESULT = Path(__file__).parent / "results" / "kill_and_resume.json"
STEPS = 8


def train(folder: Path, threads: int) -> None:
    """Begin the run, or go on with it, and write the hash of its last state."""
    import jax
    import numpy as np
    from device_equivalence import CONFIG, SENSOR

    from fcos_lidar_jax.commands.runs import Plan, Rhythm, Run
    from fcos_lidar_jax.data.pipeline import make_batches
    from fcos_lidar_jax.data.synthetic.frame_set import SimulatedFrames

    config = dataclasses.replace(
        CONFIG,
        copy_paste=None,
        class_balanced=False,
        optimizer=dataclasses.replace(CONFIG.optimizer, batch_size=2),
    )
    run = Run(folder, Plan(config, SENSOR, STEPS, 0, {}), Rhythm(save_every=1, evaluate_every=STEPS + 1), None)
    frames = SimulatedFrames(SENSOR, 12)
    state = run.train(
        lambda first: make_batches(
            frames, config, seed=0, num_steps=STEPS, first_step=first, threads=threads, workers=0
        ),
        resume=(folder / "run.json").exists(),
    )
    whole = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves((state.params, state.batch_stats, state.opt_state, state.ema)):
        whole.update(np.asarray(leaf).tobytes())
    steps = [json.loads(line)["step"] for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert steps == list(range(1, STEPS + 1)), steps
    (folder / "hash.txt").write_text(whole.hexdigest())


def start(folder: Path, threads: int, cache: Path) -> subprocess.Popen[bytes]:
    """A process that trains."""
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, __file__, "--train", str(folder), "--threads", str(threads)]
    with (folder.parent / f"{folder.name}.log").open("ab") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


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
    while process.poll() is None and time.monotonic() < until:
        there = list(checkpoints.glob("[0-9]*")) if checkpoints.is_dir() else []
        newest = max((int(path.name) for path in there), default=0)
        if newest >= wanted and not in_save:
            time.sleep(chance.uniform(0, 0.3))
            break
        if newest >= wanted and list(checkpoints.glob(".*")):
            break
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()
    unfinished = len(list(checkpoints.glob(".*"))) if checkpoints.is_dir() else 0
    kept = sorted(int(path.name) for path in checkpoints.glob("[0-9]*")) if checkpoints.is_dir() else []
    return {"newest_checkpoint": kept[-1] if kept else None, "unfinished_checkpoints": unfinished}


def main() -> None:
    """Kill, resume, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--out", type=Path, default=RESULT, help="JSON file (default: %(default)s)")
    parser.add_argument("--train", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--threads", type=int, default=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.train is not None:
        train(args.train, args.threads)
        return
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
    result = {
        "command": "python experiments/kill_and_resume.py",
        "steps": STEPS,
        "runs": len(runs),
        "killed_while_saving": sum(run["unfinished_checkpoints"] > 0 for run in runs),
        "ended_the_same": sum(run["same"] for run in runs),
        "each": runs,
        **hardware(),
    }
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"{result['ended_the_same']} of {len(runs)} ended in exactly the state of the run that was left alone")
    if result["ended_the_same"] != len(runs):
        sys.exit(1)


if __name__ == "__main__":
    main()
