"""Jobs in worker processes that fail; tests/simulation/test_nuscenes_export.py asks for their results."""

import multiprocessing
import os
import time

import pytest

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
