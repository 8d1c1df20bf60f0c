"""Detectors from files."""

from pathlib import Path

from fcos_lidar_jax.inference.detector import CloudDetector, TrainedDetector
from fcos_lidar_jax.inference.export import load_exported
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.training.checkpoint import load_checkpoint
from fcos_lidar_jax.training.checkpoints import find_checkpoint


def load_detector(checkpoint: str | Path) -> CloudDetector:
    """A detector from a checkpoint, a run, weights that come with the package, or an exported file.

    See :func:`find_checkpoint` and :func:`~fcos_lidar_jax.inference.export.load_exported`.

    Raises:
        CheckpointError: naming the folder or file, what was found and what was expected.
    """
    found = find_checkpoint(Path(checkpoint))
    return load_exported(found) if found.is_file() else load_trained(found)


def load_trained(checkpoint: str | Path) -> TrainedDetector:
    """As :func:`load_detector`, with the weights: an exported file is refused."""
    read = load_checkpoint(find_checkpoint(Path(checkpoint)))
    return TrainedDetector(build_detector(read.config, read.sensor), read.variables)
