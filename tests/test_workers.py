"""Jobs in worker processes that fail or are ended; tests/simulation/test_nuscenes_export.py asks for results."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest
from commands import child_environment

from fcos_lidar_jax.workers import run_jobs


def sleep(shared: float, job: int | None) -> int:
    """A negative job ends its process, and none is an error."""
    if job is None:
        raise ValueError("a.bin: no such file")
    time.sleep(shared * job) if job >= 0 else os._exit(1)
    return job


def test_a_dead_worker_gets_one_line_and_an_error_reaches_the_caller_and_ends_the_others():
    results = run_jobs(sleep, 60.0, [0, 10, -1], 2)
    assert next(results) == 0
    with pytest.raises(OSError, match="a worker process died, possibly out of memory: try fewer workers"):
        next(results)
    with pytest.raises(ValueError, match="no such file"):
        list(run_jobs(sleep, 60.0, [None, 10], 2))
    assert multiprocessing.active_children() == []


WORKING = """
import multiprocessing
from fcos_lidar_jax.workers import run_jobs
from test_workers import sleep
if __name__ == "__main__":
    for _ in run_jobs(sleep, 60.0, [0, 10, 10], 2):
        print(len(multiprocessing.active_children()), flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("send", "number"), [(os.killpg, signal.SIGINT), (os.kill, signal.SIGKILL)])
def test_workers_end_with_their_parent(tmp_path, send, number):
    """Ctrl-C goes to the whole process group; a kill to the parent only."""
    (tmp_path / "working.py").write_text(WORKING)
    words, how = [sys.executable, tmp_path / "working.py"], {"env": child_environment(), "start_new_session": True}
    with subprocess.Popen(words, stdout=-1, stderr=-1, text=True, **how) as process:
        assert process.stdout.readline() == "2\n"
        send(process.pid, number)
        _, errors = process.communicate(timeout=60)  # until the workers, too, have closed the pipes
    assert process.returncode == -number
    assert errors.count("Traceback") <= 1
