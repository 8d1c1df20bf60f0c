"""Optimizer, step, loop and checkpoints."""

from fcos_lidar_jax.training.checkpoint import Checkpoint, CheckpointError, load_checkpoint, save_checkpoint
from fcos_lidar_jax.training.loop import NonFiniteLossError, fit
from fcos_lidar_jax.training.optimizer import make_optimizer
from fcos_lidar_jax.training.step import detection_variables, make_state, make_train_step

__all__ = [
    "Checkpoint",
    "CheckpointError",
    "NonFiniteLossError",
    "detection_variables",
    "fit",
    "load_checkpoint",
    "make_optimizer",
    "make_state",
    "make_train_step",
    "save_checkpoint",
]
