"""Hardware and versions, recorded with the figures of an experiment."""

import functools
import subprocess
from pathlib import Path
from typing import Any

import fcos_lidar_jax
from fcos_lidar_jax.inference.timing import machine


@functools.cache
def hardware() -> dict[str, Any]:
    """Describe device, processor, cores, versions and revision, at the first call of a process."""
    git = ["git", "-C", str(Path(fcos_lidar_jax.__file__).parent), "describe", "--always", "--dirty"]
    described = subprocess.run(git, capture_output=True, text=True, check=False)
    return {**machine(), "git": described.stdout.strip() or "unknown"}
