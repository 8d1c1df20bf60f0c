"""Other programs, timed in processes of their own, turn by turn with ours: the speed of a machine drifts.

A peer is a Python file that defines ``FNS``, name -> function that runs once and waits.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import jax

_WORKER = """
import json, os, runpy, sys, time
real = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
sys.path.insert(0, os.path.dirname(sys.argv[1]))
run = runpy.run_path(sys.argv[1])["FNS"][sys.argv[2]]
run()
print("ready", file=real, flush=True)
for _ in sys.stdin:
    began = time.perf_counter()
    run()
    print(json.dumps(time.perf_counter() - began), file=real, flush=True)
"""


class Peer:
    """A function of a peer, in a process of its own.

    Args:
        file: of the peer.
        name: of the function.
        environment: variables that the peer reads.
        python: interpreter; default: this one.
    """

    def __init__(
        self, file: Path, name: str, environment: Mapping[str, str] | None = None, python: Path | None = None
    ) -> None:
        """Start it, and run the function once."""
        self._process = subprocess.Popen(
            [str(python or sys.executable), "-c", _WORKER, str(file.absolute()), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, **(environment or {})},
        )
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != "ready":
            raise SystemExit(f"error: {file}: found no FNS[{name!r}] that runs")

    def seconds(self) -> float:
        """Of one more run."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()
        return float(json.loads(self._process.stdout.readline()))

    def __enter__(self) -> "Peer":
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def turn_by_turn(ours: Callable[[], Any], peer: Peer, repeats: int) -> dict[str, float]:
    """Medians of our call and a peer's, in seconds, and their ratio."""
    jax.block_until_ready(ours())
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(ours())
        times["ours"].append(time.perf_counter() - began)
        times["peer"].append(peer.seconds())
    medians = {name: round(statistics.median(values), 4) for name, values in times.items()}
    return {**medians, "ratio": round(medians["ours"] / medians["peer"], 3), "repeats": repeats}
