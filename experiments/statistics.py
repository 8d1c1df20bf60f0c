"""Statistics of repeated measurements: times of calls that take turns, intervals over seeds."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

Call = Callable[[], Any]
Times = dict[str, float]
K = TypeVar("K")


def interleaved(calls: Mapping[K, Call], repeats: int) -> dict[K, Times]:
    """Median and 99th percentile of calls that take turns, in milliseconds, after one run each that compiles.

    The speed of a machine drifts: turns keep comparisons fair. With fewer than a hundred turns the percentile is
    close to the slowest.

    Raises:
        ValueError: no turn at all.
    """
    if repeats < 1:
        raise ValueError(f"repeats: got {repeats}, expected at least 1")
    for call in calls.values():
        jax.block_until_ready(call())
    found: dict[K, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            found[name].append(1e3 * (time.perf_counter() - began))
    return {
        name: {"median_ms": round(float(np.median(ms)), 3), "p99_ms": round(float(np.percentile(ms, 99)), 3)}
        for name, ms in found.items()
    }


def interval(values: Sequence[float]) -> tuple[float, float, float] | None:
    """Mean and 95 % interval of Student's t over seeds; None for fewer than two.

    >>> [round(v, 3) for v in interval([1.0, 2.0, 3.0])]
    [2.0, -0.484, 4.484]
    """
    from scipy.stats import t

    if len(values) < 2:
        return None
    mean, error = float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))
    half = float(t.ppf(0.975, len(values) - 1)) * error
    return mean, mean - half, mean + half
