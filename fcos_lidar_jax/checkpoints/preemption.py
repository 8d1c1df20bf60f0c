"""Signals that ask a run to stop."""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import ClassVar

import jax

from fcos_lidar_jax.signals import REPEATED_S, watch_signals

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether a run has been asked to stop."""

    signal: int | None = None  # SIGINT (Ctrl-C) or SIGTERM; None without a request
    until_s: ClassVar[float] = 0.0  # a Ctrl-C until this time repeats the process's last request


@contextlib.contextmanager
def stop_requests(line: str | None = None, *, active: bool = True) -> Iterator[StopRequest]:
    """Turn the first Ctrl-C or SIGTERM into a request that the run checks between steps. A second Ctrl-C, at least
    two seconds later, ends it.

    Further SIGTERMs change nothing, because clusters may send two; the command line ends the process at a later
    one. Signals keep their handlers with ``active=False`` and outside the main thread, where Python
    delivers none.

    The first signal prints the line, if one is given, on standard error at once, even while XLA compiles.
    """
    request, told, outer_s = StopRequest(), False, StopRequest.until_s
    in_main_thread = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in _SIGNALS if active and in_main_thread}
    interrupt = handlers.get(signal.SIGINT)

    def ask(number: int, frame: FrameType | None) -> None:
        # This handler stays, for the command line ends the process if the first signal has its own handler.
        now_s = time.monotonic()
        if number == signal.SIGINT and now_s < StopRequest.until_s:
            return
        if request.signal is None:
            request.signal, StopRequest.until_s = number, now_s + REPEATED_S
        elif number == signal.SIGINT and callable(interrupt):
            interrupt(number, frame)

    def tell(number: int) -> None:
        nonlocal told
        if number in _SIGNALS and not told:
            told = True
            again = "; press Ctrl-C again to stop now, without saving" if number == signal.SIGINT else ""
            with contextlib.suppress(OSError):  # nobody reads it
                print(f"{line}{again}", file=sys.stderr, flush=True)

    for number in handlers:
        signal.signal(number, ask)
    try:
        with watch_signals(tell) if line and handlers else contextlib.nullcontext():
            yield request
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if request.signal is not None:
            StopRequest.until_s = outer_s


def take_sigterm_back() -> None:
    """Deliver SIGTERM to Python again; in a cluster, JAX's preemption service has taken it over.

    For work without preemption sync points. JAX does not notice later SIGTERMs.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or not jax.distributed.is_initialized():
        return
    # Python still reports its own handler: it does not know that JAX has replaced it.
    if (handler := signal.getsignal(signal.SIGTERM)) is not None:
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def after_the_block() -> Iterator[None]:
    """Delay the first Ctrl-C or SIGTERM until the end of the block.

    A library's event loop would report it as a failure of the library. Nothing is delayed outside the main thread,
    or in a cluster, where JAX's preemption service handles SIGTERM.
    """
    with stop_requests(active=not jax.distributed.is_initialized()) as request:
        yield
    if request.signal is not None:
        signal.raise_signal(request.signal)
