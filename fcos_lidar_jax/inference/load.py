"""Detectors from files."""

from pathlib import Path
from typing import Literal, get_args

from fcos_lidar_jax.checkpoints.retention import find_checkpoint, load_checkpoint
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.inference.detector import CloudDetector, TrainedDetector
from fcos_lidar_jax.inference.export import load_exported
from fcos_lidar_jax.inference.openvino import with_openvino
from fcos_lidar_jax.models import build_detector

Backend = Literal["xla", "openvino"]


def load_detector(checkpoint: str | Path, *, backend: Backend = "xla") -> CloudDetector:
    """Load a detector from a checkpoint, a run, shipped weights, or an exported file.

    Args:
        checkpoint: path or name, see :func:`~fcos_lidar_jax.checkpoints.find_checkpoint`.
        backend: runtime of the network: XLA, or OpenVINO, which is faster on CPUs and needs the extra ``cpu``, see
            :func:`~fcos_lidar_jax.inference.openvino.with_openvino`.

    Raises:
        CheckpointError: names the folder or file, what was found and what was expected.
        ValueError: the backend is not installed or does not run here.

    >>> load_detector("quickstart").classes[:2]
    ('car', 'truck')
    """
    check(backend in get_args(Backend), "backend", backend, f"one of {', '.join(get_args(Backend))}")
    path = find_checkpoint(Path(checkpoint))
    if backend == "openvino":
        return with_openvino(load_trained(path))
    return load_exported(path) if path.is_file() else load_trained(path)


def load_trained(checkpoint: str | Path) -> TrainedDetector:
    """Load a detector with access to its weights, from anything :func:`load_detector` takes but exported files."""
    loaded = load_checkpoint(checkpoint)
    return TrainedDetector(build_detector(loaded.config, loaded.sensor), loaded.variables)
