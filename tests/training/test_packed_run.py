"""A run whose batches are transferred packed equals one with plain batches, with the whole network."""

from contextlib import contextmanager

import pytest
from tiny_run import STEPS, bits, train_tiny, weights

from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.training import run as runs
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.types import Batch, PackedBatch


@pytest.mark.slow
def test_a_run_with_packed_batches_is_bit_identical(tmp_path, monkeypatch):
    kinds = []

    @contextmanager
    def noted(batches, mesh):
        with feed(batches, mesh) as stream:
            yield (kinds.append(type(host.batch)) or host for host in stream)

    monkeypatch.setattr(runs, "feed", noted)
    packed = train_tiny(tmp_path / "packed", weights=weights(), packing=True)
    plain = train_tiny(tmp_path / "plain", weights=weights())  # the default for CPUs
    assert kinds == [PackedBatch] * STEPS + [Batch] * STEPS
    assert bits(packed) == bits(plain)
    losses = [[line["loss/total"] for line in read_metrics(tmp_path / name)] for name in ("packed", "plain")]
    assert losses[0] == losses[1]
