"""Metrics of detections against ground truth, and results files."""

from fcos_lidar_jax.evaluation.summary import evaluate_detections

__all__ = ["evaluate_detections"]
