"""Interleaved timing of calls, and a description of the machine."""

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
    """Time calls in turn, after one call each to compile: median and a percentile in milliseconds.

    Interleaving keeps comparisons fair when the speed of the machine drifts.
    """
    for call in calls.values():
        jax.block_until_ready(call())
    times_ms: dict[K, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            times_ms[name].append(1e3 * (time.perf_counter() - began))
    places = {"median_ms": 50, f"p{percentile}_ms": percentile}
    return {
        name: {key: round(float(np.percentile(ms, place)), 3) for key, place in places.items()}
        for name, ms in times_ms.items()
    }


def machine() -> dict[str, Any]:
    """Device, processor, number of cores, and versions, as a JSON object."""
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
