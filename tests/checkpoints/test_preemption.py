"""Ctrl-C and SIGTERM become requests; the second one acts as it would have without us."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from fcos_lidar_jax.checkpoints.preemption import after_the_block, stop_requests

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Before(Exception):
    """What the handlers raise that were there before."""


@pytest.fixture
def before():
    """Handlers of our own, so that a second SIGTERM does not end the tests."""

    def handler(number, _):
        raise Before(number)

    kept = {number: signal.signal(number, handler) for number in SIGNALS}
    yield handler
    for number, old in kept.items():
        signal.signal(number, old)


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_and_the_second_acts_as_before(before, number):
    with stop_requests() as request:
        assert request.signal is None
        os.kill(os.getpid(), number)
        assert request.signal == number
        for again in SIGNALS:
            with pytest.raises(Before):
                os.kill(os.getpid(), again)
    assert request.signal == number


def test_handlers_are_restored_after_the_work_and_after_an_error(before):
    with stop_requests():
        assert all(signal.getsignal(number) is not before for number in SIGNALS)
    assert all(signal.getsignal(number) is before for number in SIGNALS)
    with pytest.raises(KeyError), stop_requests():
        raise KeyError
    assert all(signal.getsignal(number) is before for number in SIGNALS)


def test_inactive_leaves_the_signals_alone(before):
    with stop_requests(active=False) as request:
        assert all(signal.getsignal(number) is before for number in SIGNALS)
        with pytest.raises(Before):
            os.kill(os.getpid(), signal.SIGINT)
    assert request.signal is None


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_acts_when_the_block_has_ended(before, number):
    done = []

    def work():
        with after_the_block():
            os.kill(os.getpid(), number)
            done.append(number)

    with pytest.raises(Before):
        work()
    assert done == [number]
    assert signal.getsignal(number) == before


def test_elsewhere_than_in_the_main_thread_nothing_changes(before):
    with ThreadPoolExecutor(1) as pool, after_the_block():
        held = signal.getsignal(signal.SIGINT)

        def inside():
            with after_the_block():
                return signal.getsignal(signal.SIGINT)

        assert pool.submit(inside).result() == held
