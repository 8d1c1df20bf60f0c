"""Timing of other programs in turns with ours, because the speed of a machine drifts.

A peer is a Python file that defines ``FNS``, name -> function that runs once and waits.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

_WORKER = """
import os, runpy, sys, time
real = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
sys.path.insert(0, os.path.dirname(sys.argv[1]))
run = runpy.run_path(sys.argv[1])["FNS"][sys.argv[2]]
run()
print("ready", file=real, flush=True)
for _ in sys.stdin:
    began = time.perf_counter()
    run()
    print(time.perf_counter() - began, file=real, flush=True)
"""


def turn_by_turn(
    ours: Callable[[], Any],
    repeats: int,
    *,
    peer: Path,
    name: str,
    environment: Mapping[str, object],
    python: str | Path = sys.executable,
) -> dict[str, float]:
    """Time our call and a peer's function in turns, after one run of each: medians in seconds and their ratio.

    The peer runs in a separate process with its own interpreter and environment.
    """
    command = [python, "-c", _WORKER, peer.absolute(), name]
    variables = {**os.environ, **{key: str(value) for key, value in environment.items()}}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    with subprocess.Popen(command, env=variables, bufsize=1, **pipes) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise SystemExit(f"error: {peer}: found no FNS[{name!r}] that runs")
        jax.block_until_ready(ours())
        for _ in range(repeats):
            began = time.perf_counter()
            jax.block_until_ready(ours())
            times["ours"].append(time.perf_counter() - began)
            process.stdin.write("go\n")
            times["peer"].append(float(process.stdout.readline()))
    medians = {name: round(statistics.median(values), 4) for name, values in times.items()}
    return {**medians, "ratio": round(medians["ours"] / medians["peer"], 3), "repeats": repeats}
