"""Where an experiment ran, and with what: kept beside its figures."""

import functools
import subprocess
from pathlib import Path
from typing import Any

import fcos_lidar_jax
from fcos_lidar_jax.inference.timing import machine


@functools.cache
def hardware() -> dict[str, Any]:
    """Device, processor, cores, versions and revision, as JSON; as they were at the process's first call."""
    git = ["git", "-C", str(Path(fcos_lidar_jax.__file__).parent), "describe", "--always", "--dirty"]
    described = subprocess.run(git, capture_output=True, text=True, check=False)
    return {**machine(), "git": described.stdout.strip() or "unknown"}


def hardware_line() -> str:
    """Device, processor and cores in a few words."""
    here = hardware()
    return f"{here['device']} ({here['processor']}, {here['cores']} cores)"
