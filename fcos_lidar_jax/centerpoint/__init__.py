"""CenterPoint on pillars: configuration, network, targets, losses and candidates."""

from fcos_lidar_jax.centerpoint.config import CenterPointConfig, PillarConfig

__all__ = ["CenterPointConfig", "PillarConfig"]
