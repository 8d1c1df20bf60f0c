"""Detection: load a detector, and turn point clouds, frames and drives into boxes."""

from fcos_lidar_jax.inference.detect import Stages, make_detect, make_stages
from fcos_lidar_jax.inference.detected_boxes import DetectedBox, DetectedBoxes
from fcos_lidar_jax.inference.detector import CloudDetector, TrainedDetector
from fcos_lidar_jax.inference.load import Backend, load_detector, load_trained
from fcos_lidar_jax.inference.loop import Prediction
from fcos_lidar_jax.inference.prediction import evaluate, predict

__all__ = [
    "Backend",
    "CloudDetector",
    "DetectedBox",
    "DetectedBoxes",
    "Prediction",
    "Stages",
    "TrainedDetector",
    "evaluate",
    "load_detector",
    "load_trained",
    "make_detect",
    "make_stages",
    "predict",
]
