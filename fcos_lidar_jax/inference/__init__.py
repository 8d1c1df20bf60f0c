"""From points to boxes."""

from fcos_lidar_jax.inference.detect import make_detect, postprocess, select_candidates
from fcos_lidar_jax.inference.detector import TrainedDetector, load_detector

__all__ = ["TrainedDetector", "load_detector", "make_detect", "postprocess", "select_candidates"]
