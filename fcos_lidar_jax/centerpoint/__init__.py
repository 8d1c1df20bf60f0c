"""CenterPoint on pillars: configuration, network, targets, losses and candidates."""

from fcos_lidar_jax.centerpoint.config import CenterPointConfig
from fcos_lidar_jax.centerpoint.pillar_config import PillarConfig

__all__ = ["CenterPointConfig", "PillarConfig"]
