"""Weighted losses and metrics of a batch, for any detector."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from fcos_lidar_jax.config import LossConfig
from fcos_lidar_jax.losses import weighted
from fcos_lidar_jax.models import Detector
from fcos_lidar_jax.types import Batch, Sums

Metrics = dict[str, Array]


def make_objective(detector: Detector) -> Callable[[Any, Any, Batch], tuple[Metrics, tuple[Any, Sums]]]:
    """Make the weighted losses of a batch of raw points, grouped by the count that normalises them.

    Sums and counts add up over micro-batches and devices; :func:`batch_metrics` divides them once.

    Returns:
        pure ``(params, batch_stats, batch) -> ({count: weighted sum}, (batch_stats, sums))``.
    """
    prepare, config = jax.vmap(detector.prepare), detector.config.loss

    def objective(params: Any, batch_stats: Any, batch: Batch) -> tuple[Metrics, tuple[Any, Sums]]:
        inputs = prepare(batch.points, batch.valid)
        variables = {"params": params, "batch_stats": batch_stats}
        outputs, batch_stats = detector.apply(variables, inputs, train=True)
        sums = detector.sums(variables, outputs, inputs, batch)
        totals = {count: weighted(losses, config) for count, losses in sums.losses.items()}
        counts = sums.counts | {"dropped_points": inputs.num_dropped.sum()}
        return totals, (batch_stats, sums._replace(counts=counts))

    return objective


def batch_metrics(sums: Sums, config: LossConfig) -> Metrics:
    """Metrics of a whole batch: its counts, and each loss and mean divided once by its count (at least 1)."""

    def divided(parts: dict[str, Metrics]) -> Metrics:
        by = {count: jnp.maximum(sums.counts[count], 1) for count in parts}
        return {name: value / by[count] for count, part in parts.items() for name, value in part.items()}

    losses = divided(sums.losses)
    losses["total"] = weighted(losses, config)
    return {f"loss/{name}": value for name, value in losses.items()} | sums.counts | divided(sums.means)
