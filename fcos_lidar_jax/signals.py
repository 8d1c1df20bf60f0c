"""Signals, seen at once."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator

REPEATED_S = 2.0  # `timeout` sends a signal to the process and to its group: until then it is the same one


@contextlib.contextmanager
def watch_signals(handle: Callable[[int], object]) -> Iterator[None]:
    """Call ``handle`` in another thread with the number of each signal that has a handler in Python.

    Python calls handlers only when the main thread returns from C, where XLA may compile for minutes. But it
    writes the number of each signal to a pipe at once, which this thread reads. An outer watch, or an event loop,
    gets the signals too. Only for the main thread.
    """
    read, write = os.pipe()
    os.set_blocking(write, False)
    outer = signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def watch() -> None:
        while number := os.read(read, 1):
            if outer != -1:
                with contextlib.suppress(OSError):  # full or closed
                    os.write(outer, number)
            handle(number[0])

    (watching := threading.Thread(target=watch, daemon=True)).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(outer)
        os.close(write)
        watching.join()
        os.close(read)
