"""Train, predict and evaluate, for the commands and for Python alike."""

from fcos_lidar_jax.trainer.prediction import Prediction, evaluate, predict
from fcos_lidar_jax.trainer.run import Schedule, train

__all__ = ["Prediction", "Schedule", "evaluate", "predict", "train"]
