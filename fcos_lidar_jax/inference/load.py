"""Detectors from files."""

from pathlib import Path
from typing import Literal, get_args

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.checkpoints.storage import load_checkpoint
from fcos_lidar_jax.inference.detector import CloudDetector, TrainedDetector
from fcos_lidar_jax.inference.export import load_exported
from fcos_lidar_jax.inference.openvino import with_openvino
from fcos_lidar_jax.models import build_detector

Backend = Literal["xla", "openvino"]


def load_detector(checkpoint: str | Path, *, backend: Backend = "xla") -> CloudDetector:
    """A detector from a checkpoint, a run, weights that come with the package, or an exported file.

    See :func:`find_checkpoint` and :func:`~fcos_lidar_jax.inference.export.load_exported`.

    Args:
        checkpoint: where the detector is.
        backend: what the network runs in: XLA, or, faster on CPUs, OpenVINO, which needs the extra ``cpu``; see
            :func:`~fcos_lidar_jax.inference.openvino.with_openvino`.

    Raises:
        CheckpointError: naming the folder or file, what was found and what was expected.
        ValueError: the backend is not installed, or does not run here.

    >>> load_detector("quickstart").classes[:2]
    ('car', 'truck')
    """
    if backend not in get_args(Backend):
        raise ValueError(f"backend: got {backend!r}, expected one of {', '.join(get_args(Backend))}")
    found = find_checkpoint(Path(checkpoint))
    if backend == "openvino":
        if found.is_file():
            raise ValueError(f"backend openvino: {found}: found an exported program, expected a checkpoint")
        return with_openvino(load_trained(found))
    return load_exported(found) if found.is_file() else load_trained(found)


def load_trained(checkpoint: str | Path) -> TrainedDetector:
    """As :func:`load_detector`, with the weights: an exported file is refused.

    >>> load_trained("quickstart").config.name
    'quickstart'
    """
    read = load_checkpoint(find_checkpoint(Path(checkpoint)))
    return TrainedDetector(build_detector(read.config, read.sensor), read.variables)
