"""Evaluation of detections against ground truth."""

from fcos_lidar_jax.evaluation.summary import evaluate_detections

__all__ = ["evaluate_detections"]
