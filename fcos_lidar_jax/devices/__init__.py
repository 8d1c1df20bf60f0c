"""Several devices and processes: mesh, transfer of batches, launchers, and agreement between processes."""

from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, pmap_step, replicate, shard_batch

__all__ = ["feed", "jit_step", "make_mesh", "pmap_step", "replicate", "shard_batch"]
