"""Trained detectors on disk: single checkpoints, the checkpoints of a run, and requests to stop a run."""

from fcos_lidar_jax.checkpoints.retention import find_checkpoint, load_checkpoint, load_state
from fcos_lidar_jax.checkpoints.storage import Checkpoint, CheckpointError, save_checkpoint

__all__ = ["Checkpoint", "CheckpointError", "find_checkpoint", "load_checkpoint", "load_state", "save_checkpoint"]
