"""The watch for signals: every watch sees them at once, and it leaves nothing behind."""

import os
import queue
import signal
import threading

from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.signals import watch_signals


def test_every_watch_and_the_handler_get_a_signal():
    outer, inner, handled = queue.Queue(), queue.Queue(), []
    before = signal.signal(signal.SIGUSR1, lambda number, _: handled.append(number))
    try:
        with watch_signals(outer.put), watch_signals(inner.put):
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGUSR1)
                assert inner.get(timeout=60) == outer.get(timeout=60) == signal.SIGUSR1
        with watch_signals(outer.put):
            with watch_signals(inner.put):
                pass
            os.kill(os.getpid(), signal.SIGUSR1)
            assert outer.get(timeout=60) == signal.SIGUSR1
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert handled == [signal.SIGUSR1] * 3
    assert inner.empty()
    assert outer.empty()


def test_the_watch_leaves_nothing_behind():
    def state():
        descriptor = signal.set_wakeup_fd(-1)
        signal.set_wakeup_fd(descriptor)
        return descriptor, threading.active_count(), len(os.listdir("/proc/self/fd"))

    before = state()
    assert exit_code("program", lambda: None) == 0
    assert state() == before
    with watch_signals(print):
        assert state() != before
    assert state() == before
