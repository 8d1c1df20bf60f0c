"""The network: the only package that knows Flax."""

from fcos_lidar_jax.models.detector import Detector, Variables, build_detector, count_parameters

__all__ = ["Detector", "Variables", "build_detector", "count_parameters"]
