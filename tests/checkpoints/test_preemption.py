"""Ctrl-C and SIGTERM become requests; a second Ctrl-C reaches the previous handler, a second SIGTERM none."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from commands import child_environment

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


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_is_a_request_and_a_second_ctrl_c_is_handled_as_before(previous, number):
    with stop_requests() as request:
        assert request.signal is None
        os.kill(os.getpid(), number)
        assert request.signal == number
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
            with after_the_block():  # while a checkpoint is saved
                os.kill(os.getpid(), signal.SIGTERM)
            with pytest.raises(Handled):
                os.kill(os.getpid(), signal.SIGINT)
    assert request.signal == number


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


BLOCKED = """
import hashlib
from fcos_lidar_jax.checkpoints.preemption import stop_requests
with stop_requests("stopping"):
    print("working", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # minutes without any Python
"""


def test_a_line_answers_the_first_signal_while_c_code_blocks_the_main_thread():
    words = [sys.executable, "-c", BLOCKED]
    with subprocess.Popen(words, env=child_environment(), stdout=-1, stderr=-1, text=True) as process:
        try:
            assert process.stdout.readline() == "working\n"
            process.send_signal(signal.SIGINT)
            line = "stopping; press Ctrl-C again to stop now, without saving\n"
            assert process.stderr.readline() == line
            process.send_signal(signal.SIGINT)
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.5)
        finally:
            process.kill()
        assert process.stderr.read() == ""
