"""Data sets to batches: open a data set, ground-truth database, copy-paste, class balance, and loader."""

from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.input_pipeline.open import open_frames

__all__ = ["make_batch", "open_frames"]
