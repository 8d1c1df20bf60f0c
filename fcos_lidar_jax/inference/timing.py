"""Times of calls that take turns, and the machine they were taken on."""

import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from fcos_lidar_jax import __version__

Call = Callable[[], Any]
Times = dict[str, float]
K = TypeVar("K")


def interleaved(calls: Mapping[K, Call], repeats: int, *, percentile: int = 99) -> dict[K, Times]:
    """Median and a percentile of calls that take turns, in milliseconds, after one run each that compiles.

    The speed of a machine drifts: turns keep comparisons fair. With few turns a high percentile is close to the
    slowest.

    Raises:
        ValueError: no turn at all.

    >>> sorted(interleaved({"nothing": lambda: None}, 2, percentile=95)["nothing"])
    ['median_ms', 'p95_ms']
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
        name: {
            "median_ms": round(float(np.median(ms)), 3),
            f"p{percentile}_ms": round(float(np.percentile(ms, percentile)), 3),
        }
        for name, ms in found.items()
    }


def machine() -> dict[str, Any]:
    """Device, processor, cores and versions, as JSON.

    >>> machine()["jax"] == jax.__version__
    True
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "device": jax.devices()[0].device_kind,
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "fcos_lidar_jax": __version__,
    }
