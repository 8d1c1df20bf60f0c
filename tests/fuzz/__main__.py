"""Does every file reader either refuse its input in one line or return valid data?

    python -m tests.fuzz --inputs 1000000 --out experiments/results/fuzz.json
    python -m tests.fuzz --only kitti --inputs 3000  # seconds

Valid files of every kind are mutated according to their structure, seeded, and read in processes of a thousand
inputs each, with Python's debugging allocator and limits of memory and time. Every input must give valid data, or
a ``ValueError`` of one line that names the file; no warning, no other exception, no slow input, no crash. A
million inputs take ten minutes on a core.
"""

import dataclasses
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path += [str(Path(__file__).parents[1] / "support")]

from experiments.script import run_script, save

from .engine import Limits, fuzz, summed
from .targets import make_targets, plain_name


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of a fuzzing run."""

    inputs: int = 1_000_000
    """Number of inputs over all targets."""
    seed: int = 0
    """Seed of the mutations."""
    only: tuple[str, ...] = ()
    """Names of targets, in any case and without spaces; default: all."""
    workers: int = os.cpu_count() or 1
    """Number of concurrent processes."""
    memory_mib: int = 2048
    """Address space that a process may add, in MiB."""
    seconds: float = 10.0
    """Time limit per input."""
    out: Path = Path("outputs/fuzz.json")
    """Destination of the figures."""


def main(args: Args) -> None:
    """Fuzz the targets, print and write the figures."""
    known = {plain_name(target.name): target for target in make_targets()}
    if unknown := [name for name in args.only if plain_name(name) not in known]:
        raise ValueError(
            f"--only: got {unknown[0]!r}, expected some of {', '.join(t.name for t in known.values())}"
        )
    targets = [known[name] for name in dict.fromkeys(map(plain_name, args.only))] or list(known.values())
    began = reported = time.monotonic()

    def report(done: int) -> None:
        nonlocal reported
        now = time.monotonic()
        if now - reported > 10:
            reported = now
            print(f"{done} inputs, {done / (now - began):.0f} per second", file=sys.stderr, flush=True)

    limits = Limits(args.memory_mib, args.seconds)
    counts, failures = fuzz(
        targets, args.inputs, seed=args.seed, workers=args.workers, limits=limits, report=report
    )
    seconds, total = time.monotonic() - began, sum(count.inputs for count in counts.values())
    causes = list(summed(failures))
    record = {
        **{"inputs": total, "seed": args.seed, "failures": len(failures), "seconds": round(seconds, 1)},
        **{"limits": dataclasses.asdict(limits), "python_malloc": os.environ.get("PYTHONMALLOC")},
        "targets": {name: _rounded(dataclasses.asdict(count)) for name, count in counts.items()},
        "causes": [{**dataclasses.asdict(failure), "times": number} for failure, number in causes],
    }
    lines = [f"{'target':22} inputs accepted refused failed slowest ms peak MiB a second"]
    for name, c in counts.items():
        rate = c.inputs / max(c.cpu_s, 1e-9)
        lines.append(
            f"{name:22} {c.inputs:6} {c.accepted:8} {c.refused:7} {c.failed:6} {c.slowest_ms:10.0f} "
            f"{c.peak_mib:8.0f} {rate:8.0f}"
        )
    lines += [f"{f.target} {f.number} {f.file}: {f.problem} ({times} times)" for f, times in causes]
    save(record, args.out, "\n".join([*lines, f"{total} inputs in {seconds:.0f} s, {len(failures)} failures"]))
    if failures:
        raise ValueError(f"got {len(failures)} failures of {len(causes)} causes, expected none")


def _rounded(record: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 1) if isinstance(value, float) else value for name, value in record.items()}


if __name__ == "__main__":
    if os.environ.get("PYTHONMALLOC") != "debug":  # which Python reads once
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "PYTHONMALLOC": "debug"})
    run_script(main, Args, __doc__)
