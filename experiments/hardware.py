"""Hardware and versions, recorded with the figures of an experiment."""

import functools
import resource
import subprocess
from pathlib import Path
from typing import Any

import jax

import fcos_lidar_jax
from fcos_lidar_jax.inference.timing import machine


@functools.cache
def hardware() -> dict[str, Any]:
    """Describe device, processor, cores, versions and revision, at the first call of a process."""
    git = ["git", "-C", str(Path(fcos_lidar_jax.__file__).parent), "describe", "--always", "--dirty"]
    described = subprocess.run(git, capture_output=True, text=True, check=False)
    return {**machine(), "git": described.stdout.strip() or "unknown"}


def peak_memory_gib() -> float:
    """Largest memory so far: of the first device if it counts its memory, otherwise of this process."""
    of_process = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    stats = jax.devices()[0].memory_stats() or {}
    return round(stats.get("peak_bytes_in_use", of_process) / 2**30, 2)
