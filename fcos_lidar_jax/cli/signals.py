"""How signals end a command, also while XLA compiles."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

from fcos_lidar_jax.signals import REPEATED_S, watch_signals

_BLOCKED_S = 5.0  # the main thread answers a signal sooner, unless C code blocks it, such as a compilation


@contextlib.contextmanager
def ending_signals(program: str) -> Iterator[None]:
    """End the block at SIGTERM and SIGHUP as at Ctrl-C, by an exception in the main thread.

    The process ends at once if the main thread does not come back from C code within seconds, or at a second
    signal. Signals that have a handler already, or are ignored, keep it.
    """
    is_main = threading.current_thread() is threading.main_thread()
    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    before = {n: h for n, h in usual.items() if is_main and h in (signal.default_int_handler, signal.SIG_DFL)}
    first_s: float | None = None
    answered = threading.Event()

    def end(number: int, _: FrameType | None) -> None:
        if answered.is_set():
            return  # a second exception would interrupt the removal of half-written files
        answered.set()
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    def watch(number: int) -> None:
        nonlocal first_s
        if number not in before:
            return
        if first_s is None:
            first_s = time.monotonic()
            if signal.getsignal(number) is end and not answered.wait(_BLOCKED_S):
                _end(program, number)
        elif time.monotonic() - first_s > REPEATED_S:
            _end(program, number)

    for number in before:
        signal.signal(number, end)
    try:
        with watch_signals(watch) if before else contextlib.nullcontext():
            try:
                yield
            finally:
                answered.set()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(program: str, number: int) -> NoReturn:
    if number == signal.SIGINT:
        os.write(2, f"{program}: interrupted\n".encode())
    os._exit(128 + number)
