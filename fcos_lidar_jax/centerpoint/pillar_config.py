"""Configuration of CenterPoint's pillars, network and targets (Yin et al., CVPR 2021)."""

import dataclasses
from typing import Annotated, Literal

from fcos_lidar_jax.fields import Between, Bounds, Checked, Count, Positive, check


@dataclasses.dataclass(frozen=True)
class PillarConfig(Checked):
    """Pillars, network and targets, by default with the authors' values for nuScenes.

    >>> PillarConfig(range_m=50.0)
    Traceback (most recent call last):
    ValueError: pillar_m: got 0.2, expected 100 m divided by a multiple of 8
    """

    range_m: Positive = 51.2  # Half the side of the square of pillars around the sensor, metres.
    pillar_m: Positive = 0.2  # Side of a pillar, metres.
    point_channels: Annotated[tuple[int, ...], Bounds(2)] = (64, 64)  # Channels of the layers on each point.
    backbone_blocks: Annotated[tuple[int, int, int], Bounds(0)] = (3, 5, 5)
    """3x3 convolutions per stage after the first, which halves the resolution."""
    backbone_widths: Annotated[tuple[int, int, int], Bounds(1)] = (64, 128, 256)  # Channels per stage.
    neck_channels: Count = 128  # Channels from each stage to the heads.
    output_stride: Literal[2, 4, 8] = 4  # Side of a heat-map cell, pillars.
    head_channels: Count = 64  # Channels of the convolutions in the heads.
    groups: tuple[int, ...] = ()
    """Group of each class, counted from 0. Each group has its own heads; () is one group of all classes."""
    min_overlap: Between = 0.1  # Determines the Gaussians' radius, see ``centres.gaussian_radius``.
    min_radius: Count = 2  # Minimum radius of a Gaussian, heat-map cells.
    centre_prior: Between = 0.1  # Initial probability of a centre.

    def __post_init__(self) -> None:
        super().__post_init__()
        side = 2 * self.range_m / self.pillar_m
        whole = abs(side - round(side)) < 1e-3 and round(side) % 8 == 0 < round(side)
        check(whole, "pillar_m", self.pillar_m, f"{2 * self.range_m:g} m divided by a multiple of 8")
        consecutive = set(self.groups) == set(range(max(self.groups, default=-1) + 1))
        check(consecutive, "groups", self.groups, "the numbers from 0 up to the last group")

    def class_groups(self, num_classes: int) -> tuple[int, ...]:
        """Group of each class."""
        return self.groups or (0,) * num_classes
