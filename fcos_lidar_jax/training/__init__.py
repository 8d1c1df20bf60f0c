"""Training: objective, optimizer, step, loop, and runs with checkpoints."""

from fcos_lidar_jax.training.loop import NonFiniteLossError, fit
from fcos_lidar_jax.training.optimizer import make_optimizer
from fcos_lidar_jax.training.plan import RunSpec, Schedule
from fcos_lidar_jax.training.run import train
from fcos_lidar_jax.training.step import detection_variables, make_state, make_train_step

__all__ = [
    "NonFiniteLossError",
    "RunSpec",
    "Schedule",
    "detection_variables",
    "fit",
    "make_optimizer",
    "make_state",
    "make_train_step",
    "train",
]
