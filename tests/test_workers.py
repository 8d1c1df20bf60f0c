"""Jobs in worker processes that fail; tests/simulation/test_nuscenes_export.py asks for their results."""

import multiprocessing
import os
import time

import pytest

from fcos_lidar_jax.workers import run_jobs


def sleep(shared: float, job: int) -> int:
    """A negative job ends its process."""
    time.sleep(shared * job) if job >= 0 else os._exit(1)
    return job


def test_a_dead_worker_gets_one_line_and_ends_the_others():
    """tests/input_pipeline/test_database.py asks the same of Ctrl-C."""
    results = run_jobs(sleep, 60.0, [0, 10, -1], 2)
    assert next(results) == 0
    with pytest.raises(OSError, match="a worker process died, possibly out of memory: try fewer workers"):
        next(results)
    assert multiprocessing.active_children() == []
