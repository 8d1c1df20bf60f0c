"""From a data set to batches: opening it, the ground-truth database, copy-paste, class balance, the loader."""

from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.input_pipeline.open import open_frames

__all__ = ["make_batch", "open_frames"]
