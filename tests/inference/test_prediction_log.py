"""Counts of removed points; tests/cli/test_evaluate.py tests the results file."""

import numpy as np

from fcos_lidar_jax.data.cloud_policy import Cloud
from fcos_lidar_jax.inference import prediction_log as results
from fcos_lidar_jax.inference.prediction import Prediction
from fcos_lidar_jax.types import Detections


def test_counts_of_all_processes_are_summed_exactly(monkeypatch):
    counts = [2**31, 2**63, 5]
    assert results._sum_over_processes(counts) == counts

    def of_two(words, tiled):
        return np.concatenate([words, words])

    monkeypatch.setattr(results.multihost_utils, "process_allgather", of_two)
    assert results._sum_over_processes(counts) == [2**32, 2**64, 10]


def test_points_of_a_cloud_that_another_process_has_read_are_not_counted():
    cloud = Cloud(np.zeros((0, 5)), np.zeros(0, bool), num_points=9, num_close=1, num_invalid=2, num_truncated=3)
    nothing = Detections(*np.zeros((3, 0)), valid=np.zeros(0, bool), num_dropped=np.int32(0))
    assert results._removed(Prediction(0, nothing, None, cloud)) == [1, 2, 3]
    assert results._removed(Prediction(0, nothing, None, None)) == [0, 0, 0]
