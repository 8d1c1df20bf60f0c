"""Trained detectors that come with the package."""

from importlib.resources import files
from pathlib import Path


def shipped_checkpoints() -> dict[str, Path]:
    """Name -> folder of the checkpoint, each small enough to try the commands with.

    >>> sorted(shipped_checkpoints())
    ['quickstart']
    """
    folder = Path(str(files("fcos_lidar_jax") / "weights"))
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()} if folder.is_dir() else {}
