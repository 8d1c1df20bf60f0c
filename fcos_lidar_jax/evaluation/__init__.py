"""Evaluation of detections against ground truth.

Files that are refused raise a ValueError of one line: the file, the sample or frame, the box (from 0) and the
field.
"""

from fcos_lidar_jax.evaluation.summary import evaluate_detections

__all__ = ["evaluate_detections"]
