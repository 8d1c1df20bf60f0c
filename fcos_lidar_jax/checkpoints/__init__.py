"""Trained detectors on disk: one checkpoint, the checkpoints of a run, and how a run is asked to stop."""

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.checkpoints.storage import Checkpoint, CheckpointError, load_checkpoint, save_checkpoint

__all__ = ["Checkpoint", "CheckpointError", "find_checkpoint", "load_checkpoint", "save_checkpoint"]
