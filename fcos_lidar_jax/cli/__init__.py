"""Entry point of the command line, which turns each failure into one line and an exit code."""

import contextlib
import gc
import io
import os
import platform
import re
import select
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TextIO

from fcos_lidar_jax import __version__
from fcos_lidar_jax.cli.signals import ending_signals

_LESS_MEMORY = (
    "for training, --optimizer.accumulate N splits each batch into N parts, --model.precision bfloat16 halves the "
    "activations, and --model.remat recomputes the largest ones; other commands need the least with --batch-size 1"
)
_PLATFORMS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")
_MAX_LINE = 1000
_CLOSED_PIPE = 128 + signal.SIGPIPE


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command of ``argv``, by default the arguments of the process; returns the exit code, see
    :func:`exit_code`.

    Usage errors exit with 2.
    """

    words = sys.argv[1:] if argv is None else [*argv]

    def work() -> None:
        if words == ["--version"]:
            print(f"fcos-lidar {__version__}")
            return
        from fcos_lidar_jax.cli.commands import parse
        from fcos_lidar_jax.cli.compilation_cache import use_compilation_cache

        gc.set_threshold(100_000, 50, 100)  # looking for garbage takes much of the time of tracing
        command = parse(words)
        use_compilation_cache()
        command()

    return exit_code("fcos-lidar", work)


def exit_code(program: str, work: Callable[[], object]) -> int:
    """Call ``work`` and explain a failure in one line on standard error, which starts with the program's name.

    Unexpected exceptions are treated as bugs: the line names a file with the full report. Ctrl-C, SIGTERM and
    SIGHUP raise an exception in ``work``, so that it leaves no half-written files; while XLA compiles, they end
    the process after a few seconds. A second signal, at least two seconds later, ends it at once.

    Returns:
        0; 1 after a failure; 130 after Ctrl-C; 141 if the reader of the output has gone.

    Raises:
        SystemExit: with 143 or 129 after SIGTERM or SIGHUP, or raised by ``work``.
    """
    if sys.stderr is None:  # else notes and errors would go to standard output
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # standard error already escapes what it cannot encode
        with contextlib.suppress(OSError):  # a full disk is reported below
            sys.stdout.reconfigure(errors="replace")
    stopped = None
    try:
        with ending_signals(program):
            code = _attempt(program, work)
    except BrokenPipeError:
        code = _CLOSED_PIPE
    except SystemExit as stop:
        code, stopped = 0, stop
    failures = [stream and _flush(stream) for stream in (sys.stdout, sys.stderr)]
    if any(isinstance(failure, BrokenPipeError) for failure in failures):
        return _CLOSED_PIPE
    if (failure := failures[0]) is not None and not code and (stopped is None or not stopped.code):
        print(f"{program}: error: standard output: cannot be written: {failure.strerror}", file=sys.stderr)
        return 1
    if stopped is not None:
        raise stopped
    return code


def _attempt(program: str, work: Callable[[], object]) -> int:
    try:
        work()
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if isinstance(error, BrokenPipeError) and any(map(_is_unread, (sys.stdout, sys.stderr))):
            raise
        line = _explain(error) or f"unexpected {type(error).__name__}: {_words(error)}: {_write_report(error)}"
        print(f"{program}: error: {line if len(line) <= _MAX_LINE else line[:_MAX_LINE] + '...'}", file=sys.stderr)
        return 1
    return 0


def _words(error: BaseException) -> str:
    return " ".join(str(error).split())


def _explain(error: Exception) -> str | None:
    """Explain an expected failure; None for a bug."""
    text = _words(error)
    if isinstance(error, RecursionError):
        return "nested too deeply: expected a file or an option with fewer levels"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return f"out of memory: {_LESS_MEMORY}"
    if _lacks_platform(error):
        name = next(filter(os.environ.get, _PLATFORMS), _PLATFORMS[0])
        expected = 'a platform of this machine, or, for NVIDIA GPUs, pip install -U "jax[cuda13]"'
        return f"{name}: got {os.environ.get(name)!r}, expected {expected}: {text}"
    if isinstance(error, RuntimeError) and "Gloo" in text:  # JAX's connection between processes on CPUs
        return f"another process ended, or the connection to it failed; see its output: {text}"
    if isinstance(error, ValueError | OSError | ArithmeticError):
        return text or f"{type(error).__name__} without a message"
    return None


def _lacks_platform(error: Exception) -> bool:
    """Whether JAX has no device of the platform that a variable of the environment names."""
    if isinstance(error, AssertionError) and any(map(os.environ.get, _PLATFORMS)):
        with contextlib.suppress(Exception):  # without CUDA's plugin, JAX has an assertion without a message
            import jax

            return not jax.devices()
        return True
    return isinstance(error, RuntimeError) and bool(re.search("nitialize backend|Unknown backend", str(error)))


def _write_report(error: Exception) -> str:
    """Write the report of a bug to a file; returns a sentence that names the file."""
    lines = [f"arguments: {sys.argv}", f"python {platform.python_version()} on {platform.platform()}"]
    for package in ("fcos-lidar-jax", "jax", "jaxlib", "flax", "numpy"):
        with contextlib.suppress(PackageNotFoundError):
            lines.append(f"{package} {version(package)}")
    try:
        handle, name = tempfile.mkstemp(prefix="fcos-lidar-", suffix=".txt")
        with open(handle, "w", encoding="utf-8", errors="replace") as file:
            file.write("\n".join([*lines, "", *traceback.format_exception(error)]))
    except OSError:
        return "this is a bug; its report could not be written"
    return f"this is a bug, please attach the full report {name} to an issue"


def _is_unread(stream: TextIO) -> bool:
    """Whether an output is a pipe whose other end is closed."""
    try:
        (poll := select.poll()).register(stream.fileno(), 0)
    except (AttributeError, OSError, ValueError):  # none, or not a file
        return False
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _flush(stream: TextIO) -> OSError | None:
    """Flush a stream; returns the failure, after which further output is discarded."""
    failure = None
    try:
        stream.flush()
    except OSError as error:
        failure = error
    except ValueError:  # closed
        return None
    if failure is not None or _is_unread(stream):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return failure
