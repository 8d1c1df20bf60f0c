"""Train, predict, evaluate: what people do with a detector, for the commands and for Python alike."""

from fcos_lidar_jax.trainer.evaluation import evaluate
from fcos_lidar_jax.trainer.prediction import Prediction, predict
from fcos_lidar_jax.trainer.run import Schedule, train

__all__ = ["Prediction", "Schedule", "evaluate", "predict", "train"]
