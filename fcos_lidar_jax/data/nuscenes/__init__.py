"""Reader of nuScenes from its official tables, without the devkit."""

from fcos_lidar_jax.data.nuscenes.reader import Boxes, NuScenes

__all__ = ["Boxes", "NuScenes"]
