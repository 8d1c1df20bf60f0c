"""Check that worker processes exit when their parent is killed."""

import signal
import time

from commands import run_python

SCRIPT = """
import multiprocessing, os, signal, time
import pytest
from fcos_lidar_jax.workers import end_with_parent
def work(ready):
    end_with_parent()
    ready.set()
    time.sleep(60)
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    context.Process(target=work, args=(ready,)).start()
    ready.wait()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_worker_exits_when_its_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(SCRIPT)
    began = time.monotonic()
    done = run_python(script)  # returns only when the worker has closed the outputs, too
    assert done.returncode == -signal.SIGKILL
    assert time.monotonic() - began < 50
