"""Configuration of CenterPoint's pillars, network and targets (Yin et al., CVPR 2021)."""

import dataclasses
import math
from typing import Literal

from fcos_lidar_jax.fields import check, check_least, check_types


@dataclasses.dataclass(frozen=True)
class PillarConfig:
    """Pillars, network and targets, by default with the authors' values for nuScenes.

    >>> PillarConfig(range_m=50.0)
    Traceback (most recent call last):
    ValueError: pillar_m: got 0.2, expected 100 m divided by a multiple of 8
    """

    range_m: float = 51.2  # Half the side of the square of pillars around the sensor, metres.
    pillar_m: float = 0.2  # Side of a pillar, metres.
    point_channels: tuple[int, ...] = (64, 64)  # Channels of the layers applied to each point.
    backbone_blocks: tuple[int, int, int] = (3, 5, 5)
    """3x3 convolutions per stage after the first, which halves the resolution."""
    backbone_widths: tuple[int, int, int] = (64, 128, 256)  # Channels per stage.
    neck_channels: int = 128  # Channels from each stage to the heads.
    output_stride: Literal[2, 4, 8] = 4  # Side of a heat-map cell, pillars.
    head_channels: int = 64  # Channels of the convolutions in the heads.
    groups: tuple[int, ...] = ()
    """Group of each class, counted from 0. Each group has its own heads; () is one group of all classes."""
    min_overlap: float = 0.1  # Determines the Gaussians' radius, see ``centres.gaussian_radius``.
    min_radius: int = 2  # Minimum radius of a Gaussian, heat-map cells.
    centre_prior: float = 0.1  # Initial probability of a centre.

    def __post_init__(self) -> None:
        check_types(self)
        check(0 < self.range_m < math.inf, "range_m", self.range_m, "a positive number of metres")
        check(0 < self.pillar_m < self.range_m, "pillar_m", self.pillar_m, f"between 0 and {self.range_m} m")
        side = 2 * self.range_m / self.pillar_m
        whole = abs(side - round(side)) < 1e-3 and round(side) % 8 == 0
        check(whole, "pillar_m", self.pillar_m, f"{2 * self.range_m:g} m divided by a multiple of 8")
        layers = len(self.point_channels) >= 1 and min(self.point_channels) >= 2
        check(layers, "point_channels", self.point_channels, "one or more integers of at least 2")
        check_least(self, 1, "neck_channels", "head_channels", "min_radius")
        check(min(self.backbone_widths) >= 1, "backbone_widths", self.backbone_widths, "counts of at least 1")
        consecutive = set(self.groups) == set(range(max(self.groups, default=-1) + 1))
        check(consecutive, "groups", self.groups, "the numbers from 0 up to the last group")
        for name in ("min_overlap", "centre_prior"):
            check(0 < getattr(self, name) < 1, name, getattr(self, name), "between 0 and 1")

    def class_groups(self, num_classes: int) -> tuple[int, ...]:
        """Group of each class."""
        return self.groups or (0,) * num_classes
