"""Is any work lost when commands are killed, started twice, or run out of disk?

    python -m experiments.studies.faults

``synthesize``, ``prepare``, ``train`` and ``evaluate`` on small data, each

- killed by SIGKILL, SIGTERM or SIGINT, up to three times at random moments of its time or of its output, and
  started again;
- started twice in one folder, at once or one a random time after the other;
- given a largest file size at which writes fail as on a full disk, then started again;
- given a folder that it must not write to;

and ``train`` resumed after its newest checkpoint was damaged. Expected: in the end the same bytes as without any
of it (of ``train`` the same state, of ``evaluate`` the same but for the time it took), no traceback, and one line
from whoever gives up. About an hour and a half on two cores. The same command goes on where it was stopped, by its
file of figures.
"""

import collections
import contextlib
import ctypes
import dataclasses
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.changes import change
from experiments.script import Options, run_script, save
from experiments.studies.device_equivalence import CONFIG, SENSOR, draw_variables
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS
from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.cli import main as command
from fcos_lidar_jax.files import atomic_write, read_json
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.training import Schedule, train
from fcos_lidar_jax.training.plan import RUN_SPEC

STEPS = 6
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
VERSION = "v1.0-synthetic"


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How often."""

    only: tuple[Literal["synthesize", "prepare", "train", "evaluate"], ...] = ()  # Commands; default: all.
    kills: int = 30  # Of each command but train.
    train_kills: int = 100  # Of train.
    pairs: int = 20  # Of processes in one folder, for each command.
    full_disks: int = 10  # For each command.
    damages: int = 20  # Of the newest checkpoint of train.
    seed: int = 0  # Of the moments.


@dataclasses.dataclass(frozen=True)
class Work:
    """A command that works in a folder, begun or resumed by the same call."""

    name: str
    run: Callable[[Path], object]
    result: Callable[[Path], object]  # what is the same in the end, however it got there


@dataclasses.dataclass(frozen=True)
class Whole:
    """A run that was left alone."""

    result: object
    seconds: float
    size: int  # bytes of its folder
    largest: int  # bytes of its largest file


class Child:
    """A command in a process forked from this one, which has imported everything and begun nothing."""

    def __init__(self, work: Work, folder: Path, before: Callable[[], object] = lambda: None) -> None:
        self.began, self.name, self.code = time.monotonic(), work.name, None
        self._errors, errors = os.pipe()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS[1:])  # until the command can answer
        self.pid = os.fork()
        if not self.pid:
            code = 70
            try:
                os.dup2(errors, 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                code = _run(work, folder, before)
                sys.stderr.flush()
            finally:
                os._exit(code)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.close(errors)

    def poll(self) -> bool:
        """Whether it is still there."""
        if self.code is None and (ended := os.waitpid(self.pid, os.WNOHANG))[0]:
            self.code = os.waitstatus_to_exitcode(ended[1])
        return self.code is None

    def wait(self) -> "Child":
        with os.fdopen(self._errors, encoding="utf-8", errors="replace") as errors:
            self.errors = errors.read()
        while self.poll():
            time.sleep(0.001)
        return self

    @property
    def lines(self) -> list[str]:
        """Why it gave up."""
        own = tuple(f"{name}: {what}" for name in (self.name, "fcos-lidar") for what in ("error: ", "interrupted"))
        return [line for line in self.errors.splitlines() if line.startswith(own)]

    def expect(self, *codes: int) -> "Child":
        """Raise ValueError unless it ended with one of the codes, in a line where it gave up."""
        traced = "Traceback (most recent call last)" in self.errors
        defect = traced or any("error: unexpected " in line for line in self.lines)
        if self.code not in codes or defect or len(self.lines) != (self.code in (1, 130)):
            raise ValueError(f"ended with {self.code}, expected {codes} and a line: {self.errors[-1500:]!r}")
        return self


def _run(work: Work, folder: Path, before: Callable[[], object]) -> int:
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell's background job ignores it
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS[1:])
        before()
        return exit_code(work.name, lambda: _succeed(work.run(folder)))
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt:
        print(f"{work.name}: interrupted", file=sys.stderr)
        return 130
    except BaseException:
        traceback.print_exc()
        return 70


def _succeed(code: object) -> None:
    if isinstance(code, int) and code:
        raise SystemExit(code)


def sizes(folder: Path) -> list[int]:
    """Bytes of all files, while others may move them."""
    found = []
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                found.append(os.path.getsize(os.path.join(place, name)))
    return found


def contents(folder: Path) -> dict[str, str]:
    """Checksum of every file but the lock."""
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.name != ".lock")
    return {str(file.relative_to(folder)): hashlib.blake2b(file.read_bytes()).hexdigest() for file in files}


def left_alone(work: Work, folder: Path) -> Whole:
    """Run twice, so that the time is that with compiled programs."""
    Child(work, folder / "first").wait().expect(0)
    child = Child(work, folder / "second").wait().expect(0)
    seconds, result = time.monotonic() - child.began, work.result(folder / "second")
    if work.result(folder / "first") != result:
        raise ValueError(f"{work.name}: two runs that were left alone differ")
    return Whole(result, seconds, sum(sizes(folder / "second")), max(sizes(folder / "second")))


def finish(work: Work, folder: Path, whole: Whole) -> None:
    """Run to the end, and compare."""
    Child(work, folder).wait().expect(0)
    _compare(work, folder, whole)


def _compare(work: Work, folder: Path, whole: Whole) -> None:
    found = work.result(folder)
    if found != whole.result:
        raise ValueError(f"ended elsewhere: {_differences(found, whole.result)}")


def _differences(found: Any, wanted: Any) -> str:
    if not isinstance(found, dict):
        return f"got {found}, expected {wanted}"
    return ", ".join(sorted(k for k in found.keys() | wanted.keys() if found.get(k) != wanted.get(k)))[:300]


def kill(work: Work, folder: Path, whole: Whole, chance: random.Random) -> dict[str, Any]:
    """Kill up to three times at random moments, then finish."""
    record: dict[str, Any] = {"killed": [], "unfinished": False}
    for _ in range(chance.choice((1, 1, 2, 3))):
        number, moment, by_size = chance.choice(SIGNALS), chance.random(), chance.random() < 0.5
        child = Child(work, folder)
        while child.poll():
            elapsed = time.monotonic() - child.began
            reached = by_size and sum(sizes(folder)) >= moment * whole.size
            if reached or elapsed >= (2 if by_size else moment) * whole.seconds:
                os.kill(child.pid, number)
                break
            time.sleep(0.002)
        child.wait().expect(0, -number, 128 + number)
        record["killed"].append(number.name if child.code else "finished")
        record["unfinished"] |= any(p.name != ".lock" and ".synthesize" not in p.name for p in folder.rglob(".*"))
    finish(work, folder, whole)
    return record


def pair(work: Work, folder: Path, whole: Whole, chance: random.Random) -> dict[str, Any]:
    """Two at once; one of them does the work, the other says why it does not or finds it done."""
    first = Child(work, folder)
    time.sleep(chance.choice((0.0, chance.uniform(0, whole.seconds))))
    children = [child.wait().expect(0, 1) for child in (first, Child(work, folder))]
    codes = sorted(child.code or 0 for child in children)
    if codes == [1, 1]:
        raise ValueError(f"neither did the work: {[child.errors[-300:] for child in children]}")
    _compare(work, folder, whole)
    return {"refused": codes[1], "said": next((child.lines[0] for child in children if child.code), "")}


def fill_disk(work: Work, folder: Path, whole: Whole, chance: random.Random) -> dict[str, Any]:
    """Writes fail beyond a random file size; then there is room again."""
    limit = int(whole.largest ** chance.uniform(0.3, 1))
    child = Child(work, folder, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
    child.wait().expect(0, 1)
    finish(work, folder, whole)
    return {"largest_file": limit, "refused": child.code, "said": "".join(child.lines)[-200:]}


def forbid(work: Work, folder: Path, whole: Whole, chance: random.Random) -> dict[str, Any]:
    """A folder that is read-only, for root too."""
    folder.mkdir()
    folder.chmod(0o555)
    child = Child(work, folder, _give_up_privileges).wait().expect(1)
    left = sizes(folder)
    folder.chmod(0o755)
    if left or str(folder) not in child.lines[0]:
        raise ValueError(f"got files {left} and {child.lines[0]!r}, expected no file and the folder's name")
    return {"said": child.lines[0]}


def _give_up_privileges() -> None:
    """All of root's capabilities, so that permissions hold for it as for anybody else."""
    if not os.geteuid():
        header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        if ctypes.CDLL(None).capset(header, none):
            raise RuntimeError("capabilities: cannot be given up")


def damage(work: Work, folder: Path, whole: Whole, chance: random.Random) -> dict[str, Any]:
    """Stop in the middle, damage a file of the newest checkpoint, go on from the one before."""
    child = Child(work, folder)
    while child.poll() and len(list((folder / CHECKPOINTS).glob("[0-9]*"))) < 2:
        time.sleep(0.002)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child.pid, signal.SIGTERM)
    child.wait().expect(0, 143, -signal.SIGTERM)
    newest = sorted((folder / CHECKPOINTS).glob("[0-9]*"))[-1]
    file = chance.choice(sorted(path for path in newest.rglob("*") if path.is_file()))
    data = bytearray(file.read_bytes())
    how = chance.choice(("cut", "flip", "empty", "remove", "more"))
    place = chance.randrange(max(len(data), 1))
    if how == "flip" and data:
        data[place] ^= 1 << chance.randrange(8)
    changed = {"cut": data[:place], "empty": b"", "more": data + b"\0"}.get(how, data)
    file.unlink() if how == "remove" else file.write_bytes(changed)
    finish(work, folder, whole)
    return {"file": str(file.relative_to(newest)), "how": how}


def _train(folder: Path) -> None:
    """Begin the run, or resume it, and write the hash of its last state into its folder."""
    config = change(copy_paste=None, class_balanced=False, optimizer__batch_size=2)(CONFIG)
    state = train(
        config,
        SimulatedFrames(SENSOR, 12),
        folder,
        steps=STEPS,
        resume=(folder / RUN_SPEC).exists(),
        weights=draw_variables(build_detector(config, SENSOR), "float32"),
        schedule=Schedule(save_every=1, evaluate_every=STEPS),
        threads=1,
    )
    whole = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves((state.params, state.batch_stats, state.opt_state, state.ema)):
        whole.update(np.asarray(leaf).tobytes())
    (folder / "hash.txt").write_text(whole.hexdigest())


def _trained(folder: Path) -> dict[str, object]:
    lines = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    kept = sorted(path.name for path in (folder / CHECKPOINTS).iterdir())
    return {"state": (folder / "hash.txt").read_text(), "steps": [line["step"] for line in lines], "kept": kept}


def _evaluated(folder: Path) -> dict[str, object]:
    summary = json.loads((folder / "metrics_summary.json").read_text())
    del summary["eval_time"]
    return {**contents(folder), "metrics_summary.json": json.dumps(summary)}


def make_works(home: Path) -> list[Work]:
    """The commands, on a data set that the first of them made."""
    data = ["--data-root", str(home / "data"), "--version", VERSION]
    made = ["synthesize", "--scenes", "2", "--keyframes", "3", "--sensor", "short_range"]
    prepared = ["prepare", *data, "--num-sweeps", "2", "--train-split", "train"]
    evaluated = ["evaluate", *data, "--checkpoint", "quickstart", "--split", "train", "--no-report"]
    works = [
        Work("synthesize", lambda folder: command([*made, "--out", str(folder)]), contents),
        Work("prepare", lambda folder: command([*prepared, "--index", str(folder)]), contents),
        Work("train", _train, _trained),
        Work("evaluate", lambda folder: command([*evaluated, "--out", str(folder)]), _evaluated),
    ]
    Child(works[0], home / "data").wait().expect(0)
    return works


def main(args: Args) -> None:
    """Every fault for every command."""
    record = _earlier(args)
    warnings.simplefilter("ignore", RuntimeWarning)  # JAX warns of forks; its threads are not begun
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        home.chmod(0o755)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(home / "cache"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        for work in (w for w in make_works(home) if not args.only or w.name in args.only):
            whole = left_alone(work, home / work.name)
            faults = {kill: args.train_kills if work.name == "train" else args.kills, pair: args.pairs}
            faults |= {fill_disk: args.full_disks, forbid: min(args.full_disks, 1)}
            faults |= {damage: args.damages} if work.name == "train" else {}
            for fault, times in faults.items():
                what = f"{work.name}: {fault.__name__}"
                each = record.setdefault(what, {"times": 0, "same": 0, "each": []})["each"]
                for number in range(len(each), times):
                    folder, chance = home / "work", random.Random(f"{args.seed} {what} {number}")
                    try:
                        each.append({**fault(work, folder, whole, chance), "same": True})
                    except ValueError as error:
                        each.append({"same": False, "problem": str(error)})
                    shutil.rmtree(folder, ignore_errors=True)
                    record[what] |= {"times": len(each), "same": sum(one["same"] for one in each)}
                    print(f"{what}: {record[what]['same']} of {len(each)} as they should be", flush=True)
                    # Without the hardware's description: it would begin JAX's threads, which forks do not survive.
                    text = json.dumps({"seed": args.seed, "faults": record})
                    atomic_write(_file(args), lambda path, text=text: path.write_text(text, encoding="utf-8"))
    killed = (s for done in record.values() for one in done["each"] for s in one.get("killed", ()))
    figures = {"seed": args.seed, "signals": collections.Counter(killed), "faults": record}
    save(figures, _file(args), f"{dict(figures['signals'])}")
    problems = [one["problem"] for done in record.values() for one in done["each"] if not one["same"]]
    if problems:
        raise ValueError(f"got {len(problems)} failures, expected none: {problems[0]}")


def _file(args: Args) -> Path:
    return args.out or Path("outputs", "faults.json")


def _earlier(args: Args) -> dict[str, Any]:
    """What a run that was stopped has found with the same seed."""
    if not _file(args).is_file():
        return {}
    found = read_json(_file(args), dict[str, Any])
    return found["faults"] if found["seed"] == args.seed else {}


if __name__ == "__main__":
    run_script(main, Args, __doc__)
