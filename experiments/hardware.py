"""Where an experiment ran, and with what: kept beside its figures."""

import functools
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax

import fcos_lidar_jax


@functools.cache
def hardware() -> dict[str, Any]:
    """Device, processor, cores, versions and revision, as JSON; as they were at the process's first call."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    git = ["git", "-C", str(Path(fcos_lidar_jax.__file__).parent), "describe", "--always", "--dirty"]
    described = subprocess.run(git, capture_output=True, text=True, check=False)
    return {
        "device": jax.devices()[0].device_kind,
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "fcos_lidar_jax": fcos_lidar_jax.__version__,
        "git": described.stdout.strip() or "unknown",
    }


def hardware_line() -> str:
    """Device, processor and cores in a few words."""
    here = hardware()
    return f"{here['device']} ({here['processor']}, {here['cores']} cores)"
