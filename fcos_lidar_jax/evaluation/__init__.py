"""Metrics of detections against ground truth, and results files.

A refused file raises a ValueError of one line: the file, the sample or frame, the box (from 0) and the field.
"""

from fcos_lidar_jax.evaluation.summary import evaluate_detections

__all__ = ["evaluate_detections"]
