"""Detectors as pure functions, and FCOS-LiDAR: network, losses and candidates."""

from fcos_lidar_jax.models.detector import Detector, Variables, build_detector, count_parameters

__all__ = ["Detector", "Variables", "build_detector", "count_parameters"]
