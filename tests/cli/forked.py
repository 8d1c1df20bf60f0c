"""Commands as other processes, forked after all imports: they start in a tenth of the time."""

import atexit
import itertools
import multiprocessing
import os
import pkgutil
import subprocess
import sys
import tempfile
from collections.abc import Callable

import pytest
from commands import child_environment

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["fcos_lidar_jax.cli.commands", __name__])


class Forked:
    """A command in another process.

    Args:
        args: words of the command.
        before: called in the process before the command; a function of a module.
        variables: environment variables that are read when the command runs, not when modules are imported.
    """

    def __init__(self, args: list[object], before: Callable[[], object] = int, **variables: str) -> None:
        self._files = tempfile.NamedTemporaryFile("r"), tempfile.NamedTemporaryFile("r")  # noqa: SIM115
        given = list(map(str, args)), before, variables, [file.name for file in self._files]
        self._process = _CONTEXT.Process(target=_run, args=given, daemon=True)
        with pytest.MonkeyPatch.context() as patch:  # of the server, which the first process starts
            for name, value in child_environment().items():
                patch.setenv(name, value)
            self._process.start()

    def poll(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            assert self._process.pid is not None
            os.kill(self._process.pid, number)

    def end(self, timeout_s: float = 200) -> tuple[int, str, str]:
        """Wait for the end; returns the exit code, standard output and standard error."""
        self._process.join(timeout_s)
        code, (out, err) = self.poll(), (file.read() for file in self._files)
        self.kill()
        if code is None:
            raise subprocess.TimeoutExpired("fcos-lidar", timeout_s, out, err)
        return code, out, err

    def kill(self) -> None:
        self._process.kill()
        self._process.join()
        for file in self._files:
            file.close()


def signal_at(place: str, number: int, call: int = 1) -> None:
    """Let this process send itself a signal where it calls ``module.function`` for the first or a later time."""
    where, _, name = place.rpartition(".")
    owner, calls = pkgutil.resolve_name(where), itertools.count(1)
    function = getattr(owner, name)

    def signalling(*args, **kwargs):
        if next(calls) == call:
            os.kill(os.getpid(), number)
        return function(*args, **kwargs)

    setattr(owner, name, signalling)


def _run(args: list[str], before: Callable[[], object], variables: dict[str, str], files: list[str]) -> None:
    from fcos_lidar_jax.cli import main

    os.environ.update(variables)
    for descriptor, file in enumerate(files, start=1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_APPEND), descriptor)
    before()
    try:
        sys.exit(main(args))
    finally:
        atexit._run_exitfuncs()  # as at the end of a process that was not forked
