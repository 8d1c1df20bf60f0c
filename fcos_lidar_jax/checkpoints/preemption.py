"""Signals that ask a run to stop."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

import jax

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether a run has been asked to stop, and by what."""

    signal: int | None = None  # SIGINT (Ctrl-C) or SIGTERM; None as long as nothing has been asked.


@contextlib.contextmanager
def stop_requests(*, active: bool = True) -> Iterator[StopRequest]:
    """Turn the first Ctrl-C or SIGTERM into a request that the run sees between two steps; the second one ends it.

    Outside the main thread, which alone Python tells of signals, and with ``active=False`` they are left alone.
    """
    request = StopRequest()
    own = active and threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in _SIGNALS if own}

    def ask(number: int, _: FrameType | None) -> None:
        request.signal = number
        for again, handler in before.items():
            signal.signal(again, handler)

    for number in before:
        signal.signal(number, ask)
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def take_sigterm_back() -> None:
    """Let SIGTERM reach Python again, from which JAX's preemption service takes it in a cluster.

    For work during which no sync point is asked for. JAX hears of no later SIGTERM.
    """
    own = threading.current_thread() is threading.main_thread()
    # Python still knows its handler, of which JAX has not told it that it is not called.
    if own and jax.distributed.is_initialized() and (handler := signal.getsignal(signal.SIGTERM)) is not None:
        signal.signal(signal.SIGTERM, handler)


@contextlib.contextmanager
def after_the_block() -> Iterator[None]:
    """Let the first Ctrl-C or SIGTERM act only when the block has ended.

    In a library's event loop it would be reported as a failure of the library. Outside the main thread, which no
    signal interrupts, nothing changes; nor in a cluster, where JAX's preemption service has taken SIGTERM by a
    handler that Python cannot see and could not restore.
    """
    with stop_requests(active=not jax.distributed.is_initialized()) as request:
        yield
    if request.signal is not None:
        signal.raise_signal(request.signal)
