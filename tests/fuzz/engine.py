"""Runs mutated inputs, a thousand per process, with limits of memory and time.

hypothesis could drive the mutators (``st.randoms``), at about two thirds of the speed, but can neither limit
memory and time nor survive a crash, and its shrinking adds nothing to inputs with one to four mutations.
"""

import dataclasses
import faulthandler
import gc
import mmap
import multiprocessing
import os
import resource
import signal
import struct
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from random import Random

from .targets import InvalidError, Target

CHUNK = 1000  # inputs per process
LONGEST_MESSAGE = 20_000  # characters, not counting the file's name: room for a few of the longest values
_STATE = struct.Struct("<5q")  # number of the current input, and the counts before it


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of a process."""

    memory_mib: int  # address space that it may add
    seconds: float  # per input


@dataclasses.dataclass
class Counts:
    """Results of a target's inputs."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    failed: int = 0
    slowest_ms: float = 0.0
    peak_mib: float = 0.0  # resident memory that a process added
    cpu_s: float = 0.0

    def add(self, other: "Counts") -> None:
        for field in dataclasses.fields(self):
            join = max if field.name in ("slowest_ms", "peak_mib") else sum
            setattr(self, field.name, join((getattr(self, field.name), getattr(other, field.name))))


@dataclasses.dataclass(frozen=True)
class Failure:
    """A mistreated input; :func:`make_input` reproduces it from seed, target and number."""

    target: str
    number: int
    file: str
    problem: str  # one line, equal for equal causes
    details: str


def make_input(target: Target, seed: int, number: int) -> tuple[str, bytes, bool]:
    """Name and content of a mutated file, and whether its checksums are corrected."""
    rng = Random(f"{seed} {target.name} {number}")
    name = rng.choice(target.mutable)
    return name, target.mutate(name, target.files[name], rng), target.seal is not None and rng.random() < 0.5


def write_files(target: Target, folder: Path) -> None:
    for name, content in target.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def try_input(target: Target, folder: Path, seed: int, number: int) -> tuple[bool, Failure | None]:
    """Whether an input is accepted, and how it is mistreated."""
    name, content, sealed = make_input(target, seed, number)
    file = folder / name
    file.write_bytes(content)
    if sealed and target.seal is not None:
        try:
            target.seal(folder, name)
        except (ValueError, RecursionError):  # no longer JSON
            file.write_bytes(content)
    problem = details = ""
    accepted = False
    try:
        target.read(folder, name)
        accepted = True
    except ValueError as error:
        problem, details = judge(str(error), str(file if target.alone else folder)), str(error)[:2000]
        if problem:
            problem += f", at {_place(error)}"
    except InvalidError as error:
        problem = f"accepted: {error}"
    except Exception as error:
        problem = f"{type(error).__name__} at {_place(error)}"
        details = "".join(traceback.format_exception(error, limit=-6))[-4000:]
    write_files(target, folder) if target.seal is not None else file.write_bytes(target.files[name])
    return accepted, Failure(target.name, number, name, problem, details) if problem else None


def judge(message: str, where: str) -> str:
    """The fault of a refusal's message, which must be one short line that names the file; "" if there is none."""
    if where not in message:
        return "a message that does not name the file"
    if message.splitlines() != [message]:
        return "a message of several lines"
    longest = LONGEST_MESSAGE + message.count(where) * len(where)
    return "" if len(message) <= longest else "a message that is too long"


def _place(error: Exception) -> str:
    """The product's line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "fcos_lidar_jax/" in frame.filename]
    frame = (own or list(frames))[-1]
    return f"{frame.filename.rpartition('fcos_lidar_jax/')[2]}:{frame.lineno}"


@dataclasses.dataclass(frozen=True)
class _Job:
    target: Target
    first: int
    last: int  # excluded


class _Worker:
    """A process that tries the inputs of a job."""

    def __init__(self, job: _Job, seed: int, limits: Limits, scratch: Path) -> None:
        self.job, self.failures, self.counts = job, list[Failure](), Counts()
        self.folder = Path(tempfile.mkdtemp(dir=scratch))
        self.state = mmap.mmap(-1, _STATE.size)
        self.state[:] = _STATE.pack(job.first, 0, 0, 0, 0)
        self.receiver, sender = multiprocessing.Pipe(duplex=False)
        args = (job, seed, limits, self.folder, self.state, sender)
        self.process: BaseProcess = multiprocessing.get_context("fork").Process(target=_work, args=args)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # JAX warns about forks; its threads have not started
            self.process.start()
        sender.close()

    def receive(self) -> bool:
        """Receive a message; False if the process has ended."""
        try:
            message = self.receiver.recv()
        except EOFError:
            self.process.join()
            return False
        if isinstance(message, Counts):
            self.counts = message
        else:
            self.failures.append(message)
        return True

    def left(self) -> _Job | None:
        """The rest of the job after a crash, which is recorded as a failure."""
        number, *done = _STATE.unpack(self.state)
        if not self.counts.inputs:
            self.counts = Counts(*done)
            self.counts.inputs, self.counts.failed = self.counts.inputs + 1, self.counts.failed + 1
            self.failures.append(self._death(number))
        left = _Job(self.job.target, number + 1, self.job.last)
        return left if left.first < left.last else None

    def _death(self, number: int) -> Failure:
        code, told = self.process.exitcode or 0, (self.folder / "faults").read_text(errors="replace")
        how = "takes too long" if code == -signal.SIGALRM else f"ends the process with {code}"
        own = [line.split('"')[1:] for line in told.splitlines() if "fcos_lidar_jax/" in line]
        where = f" at {own[0][0].rpartition('fcos_lidar_jax/')[2]}{own[0][1].partition(' in')[0]}" if own else ""
        return Failure(self.job.target.name, number, "", how + where, told[-4000:])


def _work(job: _Job, seed: int, limits: Limits, folder: Path, state: mmap.mmap, sender: Connection) -> None:
    faults = (folder / "faults").open("w")
    faulthandler.enable(faults)
    faulthandler.register(signal.SIGALRM, faults, chain=True)  # then ends the process
    warnings.simplefilter("error")
    files = folder / "files"
    files.mkdir()
    write_files(job.target, files)
    before = resource.getrusage(resource.RUSAGE_SELF)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (limits.memory_mib << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    counts = Counts()
    for number in range(job.first, job.last):
        _STATE.pack_into(state, 0, number, counts.inputs, counts.accepted, counts.refused, counts.failed)
        signal.setitimer(signal.ITIMER_REAL, limits.seconds)
        began = time.perf_counter()
        accepted, failure = try_input(job.target, files, seed, number)
        counts.slowest_ms = max(counts.slowest_ms, (time.perf_counter() - began) * 1e3)
        counts.inputs += 1
        counts.accepted += accepted
        counts.failed += failure is not None
        counts.refused += not accepted and failure is None
        if failure is not None:
            sender.send(failure)
    signal.setitimer(signal.ITIMER_REAL, 0)
    after = resource.getrusage(resource.RUSAGE_SELF)
    counts.peak_mib = (after.ru_maxrss - before.ru_maxrss) / 1024
    counts.cpu_s = after.ru_utime + after.ru_stime
    sender.send(counts)
    os._exit(0)  # skips finalisation, which would copy every shared page


def fuzz(
    targets: Sequence[Target],
    inputs: int,
    *,
    seed: int,
    workers: int,
    limits: Limits,
    report: Callable[[int], None] = lambda done: None,
) -> tuple[dict[str, Counts], list[Failure]]:
    """Try inputs, distributed over the targets.

    Args:
        workers: number of concurrent processes.
        report: called with the number of finished inputs.

    Returns:
        counts per target, and all failures.
    """
    jobs = _share_out(targets, inputs)
    counts, failures = {target.name: Counts() for target in targets}, list[Failure]()
    gc.collect()
    gc.freeze()  # so that the processes share the existing objects
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as scratch:
        running: dict[Connection, _Worker] = {}
        while jobs or running:
            while jobs and len(running) < workers:
                worker = _Worker(jobs.pop(), seed, limits, Path(scratch))
                running[worker.receiver] = worker
            for receiver in wait(list(running)):
                worker = running[receiver]  # type: ignore[index]
                if worker.receive():
                    continue
                del running[worker.receiver]
                left = worker.left()
                counts[worker.job.target.name].add(worker.counts)
                failures += worker.failures
                jobs += [left] if left else []
                report(sum(count.inputs for count in counts.values()))
    return counts, failures


def _share_out(targets: Sequence[Target], inputs: int) -> list[_Job]:
    shares = sum(target.share for target in targets)
    jobs = []
    for target in reversed(targets):
        number = max(round(inputs * target.share / shares), 1)
        firsts = range(0, number, CHUNK)
        jobs += [_Job(target, first, min(first + CHUNK, number)) for first in firsts]
    return jobs


def summed(failures: Sequence[Failure]) -> Iterator[tuple[Failure, int]]:
    """The first failure of each cause, and the number of failures."""
    causes: dict[tuple[str, str], list[Failure]] = {}
    for failure in failures:
        causes.setdefault((failure.target, failure.problem), []).append(failure)
    for same in causes.values():
        yield min(same, key=lambda failure: failure.number), len(same)
