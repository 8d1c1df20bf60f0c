"""Work shared over devices and processes: mesh, batches on their way, agreement, launchers."""

from fcos_lidar_jax.devices.mesh import jit_step, make_mesh, pmap_step, replicate, shard_batch
from fcos_lidar_jax.devices.transfer import feed

__all__ = ["feed", "jit_step", "make_mesh", "pmap_step", "replicate", "shard_batch"]
