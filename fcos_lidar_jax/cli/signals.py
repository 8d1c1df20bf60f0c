"""How signals end a command, however deep in a library they arrive."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import NoReturn

from fcos_lidar_jax.signals import watch_signals

_REPEATED_S = {signal.SIGINT: 1.0, signal.SIGTERM: 5.0, signal.SIGHUP: 5.0}
"""Until then a signal belongs to the first one: `timeout` and schedulers send signals twice, to a process and its
group, and clusters may repeat them."""


@contextlib.contextmanager
def ending_signals() -> Iterator[list[signal.Signals]]:
    """Raise SystemExit in the main thread for SIGTERM and SIGHUP, unless they have handlers already.

    Yields the signals that end the work, Ctrl-C too.
    """
    is_main = threading.current_thread() is threading.main_thread()
    numbers = [n for n in (signal.SIGTERM, signal.SIGHUP) if is_main and signal.getsignal(n) is signal.SIG_DFL]

    def end(number: int, _: object) -> NoReturn:
        for repeated in numbers:
            signal.signal(repeated, lambda *_: None)  # it would interrupt the removal of half-written files
        raise SystemExit(128 + number)

    for number in numbers:
        signal.signal(number, end)
    interrupts = is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    try:
        yield [*numbers, *([signal.SIGINT] if interrupts else [])]
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


@contextlib.contextmanager
def ended_by_a_second(numbers: Sequence[signal.Signals], program: str) -> Iterator[None]:
    """End the process at the second of the signals, even while C code blocks the main thread."""
    first_s = None

    def end(number: int) -> None:
        nonlocal first_s
        if number in numbers:
            now_s = time.monotonic()
            first_s = now_s if first_s is None else first_s
            if now_s - first_s > _REPEATED_S[signal.Signals(number)]:
                _end(program, number)

    with watch_signals(end) if numbers else contextlib.nullcontext():
        yield


def _end(program: str, number: int) -> NoReturn:
    if number == signal.SIGINT:
        os.write(2, f"{program}: interrupted\n".encode())
    os._exit(128 + number)


@contextlib.contextmanager
def raising_again() -> Iterator[None]:
    """Raise the exception of a signal again if it was lost.

    Python drops exceptions from finalizers and callbacks of weak references, and some libraries replace them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    report, dropped = sys.unraisablehook, list[BaseException]()

    def keep(unraisable: "sys.UnraisableHookArgs") -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):
            dropped.append(unraisable.exc_value)
            signal.setitimer(signal.ITIMER_REAL, 0.01)
        else:
            report(unraisable)

    def raise_again(*_: object) -> NoReturn:
        raise dropped[-1]

    before = signal.signal(signal.SIGALRM, raise_again)
    sys.unraisablehook = keep
    try:
        yield
        if dropped:
            raise dropped[-1]
    except Exception as error:
        cause: BaseException | None = error
        while (cause := cause.__cause__ or cause.__context__) is not None:
            if isinstance(cause, KeyboardInterrupt | SystemExit):  # replaced by a library
                raise cause from None
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        sys.unraisablehook = report


@contextlib.contextmanager
def ended_while_importing(program: str) -> Iterator[None]:
    """End the process at once on Ctrl-C: an interrupted import may raise any other error."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is not signal.default_int_handler:
        yield
        return

    signal.signal(signal.SIGINT, lambda number, _: _end(program, number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
