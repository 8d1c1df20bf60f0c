"""Work on several devices and processes: mesh, transfer of batches, agreement, launchers."""

from fcos_lidar_jax.devices.feeding import feed
from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, pmap_step, replicate, shard_batch

__all__ = ["feed", "jit_step", "make_mesh", "pmap_step", "replicate", "shard_batch"]
