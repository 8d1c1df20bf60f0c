"""Jobs in worker processes."""

import multiprocessing
import os
import time

import pytest

from fcos_lidar_jax.workers import run_jobs


def sleep(shared: float, job: int) -> int:
    """Squares a job after as many times the shared time; a negative job ends its process."""
    time.sleep(shared * job) if job >= 0 else os._exit(1)
    return job * job


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_returns_its_result(workers):
    assert sorted(run_jobs(sleep, 0.0, [3, 1, 2], workers)) == [1, 4, 9]


def test_a_dead_worker_gets_one_line_and_leaving_early_ends_the_others():
    with pytest.raises(OSError, match="a worker process died, possibly out of memory: try fewer workers"):
        list(run_jobs(sleep, 0.0, [1, -1], 2))
    results = run_jobs(sleep, 60.0, [0, 10], 2)
    assert next(results) == 0
    results.close()
    assert multiprocessing.active_children() == []
