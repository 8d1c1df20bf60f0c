"""From points to boxes."""

from fcos_lidar_jax.inference.detect import Stages, make_detect, make_stages
from fcos_lidar_jax.inference.detector import CloudDetector, TrainedDetector
from fcos_lidar_jax.inference.load import Backend, load_detector, load_trained

__all__ = [
    "Backend",
    "CloudDetector",
    "Stages",
    "TrainedDetector",
    "load_detector",
    "load_trained",
    "make_detect",
    "make_stages",
]
