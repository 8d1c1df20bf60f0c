"""From points to boxes."""

from fcos_lidar_jax.inference.detect import make_detect, postprocess, select_candidates

__all__ = ["make_detect", "postprocess", "select_candidates"]
