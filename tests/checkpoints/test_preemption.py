"""Ctrl-C and SIGTERM become requests; a second Ctrl-C reaches the previous handler, a second SIGTERM none."""

import os
import signal
import types
from concurrent.futures import ThreadPoolExecutor

import pytest

from fcos_lidar_jax.checkpoints import preemption
from fcos_lidar_jax.checkpoints.preemption import after_the_block, stop_requests

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Handled(Exception):
    """Raised by the previous handlers."""


@pytest.fixture
def previous():
    """Install handlers of our own, so that a second SIGTERM does not end the tests."""

    def handler(number, _):
        raise Handled(number)

    originals = {number: signal.signal(number, handler) for number in SIGNALS}
    yield handler
    for number, original in originals.items():
        signal.signal(number, original)


def handlers():
    return [signal.getsignal(number) for number in SIGNALS]


@pytest.fixture
def clock(monkeypatch):
    """Seconds that the tests set."""
    clock = types.SimpleNamespace(now_s=7.0, monotonic=lambda: clock.now_s)
    monkeypatch.setattr(preemption, "time", clock)
    return clock


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_is_a_request_and_a_later_ctrl_c_is_handled_as_before(previous, clock, number):
    with stop_requests() as request:
        assert request.signal is None
        os.kill(os.getpid(), number)
        assert request.signal == number
        os.kill(os.getpid(), signal.SIGINT)  # `timeout` sends it twice
        clock.now_s += 2.5
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
            with after_the_block():  # while a checkpoint is saved
                os.kill(os.getpid(), signal.SIGTERM)
            clock.now_s += 2.5
            with pytest.raises(Handled):
                os.kill(os.getpid(), signal.SIGINT)
    assert request.signal == number


@pytest.mark.parametrize("saving", [False, True])
def test_a_repeated_ctrl_c_counts_once_also_while_a_checkpoint_is_saved(previous, clock, saving):
    with stop_requests() as request:
        if not saving:
            os.kill(os.getpid(), signal.SIGINT)
        with after_the_block():
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)
            clock.now_s += 3.0  # the checkpoint takes long
        assert request.signal == signal.SIGINT
        os.kill(os.getpid(), signal.SIGTERM)


def test_handlers_are_restored_after_the_block_and_after_an_error(previous):
    with stop_requests():
        assert previous not in handlers()
    assert handlers() == [previous] * 2
    with pytest.raises(KeyError), stop_requests():
        raise KeyError
    assert handlers() == [previous] * 2


def test_signals_keep_their_handlers_when_inactive_or_outside_the_main_thread(previous):
    with stop_requests(active=False) as request:
        assert handlers() == [previous] * 2
    assert request.signal is None

    def inside():
        with after_the_block():
            return handlers()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(inside).result() == [previous] * 2


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_is_delayed_until_the_end_of_the_block(previous, number):
    done = []

    def work():
        with after_the_block():
            os.kill(os.getpid(), number)
            done.append(number)

    with pytest.raises(Handled):
        work()
    assert done == [number]
    assert signal.getsignal(number) == previous
