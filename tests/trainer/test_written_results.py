"""What is counted while a results file is written; the file itself is in tests/cli/test_evaluate.py."""

from types import SimpleNamespace

import numpy as np
import pytest

from fcos_lidar_jax.trainer import results
from fcos_lidar_jax.trainer.prediction import Prediction


def test_counts_of_all_processes_are_added_without_loss(monkeypatch):
    counts = [2**31, 2**63, 5]
    assert results._sum_over_processes(counts) == counts

    def of_two(words, tiled):
        return np.concatenate([words, words])

    monkeypatch.setattr(results.multihost_utils, "process_allgather", of_two)
    assert results._sum_over_processes(counts) == [2**32, 2**64, 10]


def test_of_a_cloud_that_another_process_has_read_nothing_is_counted():
    cloud = SimpleNamespace(num_close=1, num_invalid=2, num_truncated=3)
    assert results._removed(Prediction(0, None, None, cloud)) == [1, 2, 3]
    assert results._removed(Prediction(0, None, None, None)) == [0, 0, 0]
    with pytest.raises(AttributeError, match="num_close"):
        results._removed(Prediction(0, None, None, SimpleNamespace()))
