"""The choices of CenterPoint on pillars (Yin et al., CVPR 2021)."""

import dataclasses
import math
from typing import Any, Literal

from fcos_lidar_jax.config import Config, LossConfig, ModelConfig, _check, _check_choices, _check_least
from fcos_lidar_jax.sensors import Sensor

_RANGE_VIEW_LOSSES = (
    *("top_q", "regress_on", "iou_loss", "iou_weight", "iou_prediction_weight"),
    *("quality", "centreness_m"),
)
"""Fields of :class:`LossConfig` that CenterPoint has no use for."""


@dataclasses.dataclass(frozen=True)
class PillarConfig:
    """Pillars, network and targets, with the numbers that the authors publish for nuScenes.

    >>> PillarConfig(range_m=50.0)
    Traceback (most recent call last):
    ValueError: pillar_m: got 0.2, expected a part of 100 m by a multiple of 8
    """

    range_m: float = 51.2  # Half the side of the square around the sensor that is divided into pillars, metres.
    pillar_m: float = 0.2  # Side of a pillar, metres.
    point_channels: tuple[int, ...] = (64, 64)  # Of the layers that points pass before they meet in their pillar.
    backbone_blocks: tuple[int, int, int] = (3, 5, 5)
    """3x3 convolutions a stage, beside the first one of each, which halves the size."""
    backbone_widths: tuple[int, int, int] = (64, 128, 256)  # Channels a stage.
    neck_channels: int = 128  # Channels that each stage gives to the heads.
    output_stride: Literal[2, 4, 8] = 4  # Pillars a side of a cell of the heat map.
    head_channels: int = 64  # Channels of the convolution that all heads share, and of those of each head.
    groups: tuple[int, ...] = ()
    """The group of each class, counted from 0: each has heads of its own; () for one of all classes."""
    min_overlap: float = (
        0.1  # Decides the radius of a Gaussian, see fcos_lidar_jax.centerpoint.centres.gaussian_radius.
    )
    min_radius: int = 2  # Least radius of a Gaussian, cells of the heat map.
    centre_prior: float = 0.1  # Probability of a centre at the start, everywhere.

    def __post_init__(self) -> None:
        _check(0 < self.range_m < math.inf, "range_m", self.range_m, "a positive number of metres")
        _check(0 < self.pillar_m < self.range_m, "pillar_m", self.pillar_m, f"between 0 and {self.range_m} m")
        side = 2 * self.range_m / self.pillar_m
        whole = abs(side - round(side)) < 1e-3 and round(side) % 8 == 0
        _check(whole, "pillar_m", self.pillar_m, f"a part of {2 * self.range_m:g} m by a multiple of 8")
        layers = len(self.point_channels) >= 1 and min(self.point_channels) >= 2
        _check(layers, "point_channels", self.point_channels, "one or more integers of at least 2")
        _check_least(self, 1, "neck_channels", "head_channels", "min_radius")
        _check(min(self.backbone_widths) >= 1, "backbone_widths", self.backbone_widths, "counts of at least 1")
        numbered = set(self.groups) == set(range(max(self.groups, default=-1) + 1))
        _check(numbered, "groups", self.groups, "the numbers from 0 up to the last group")
        for name in ("min_overlap", "centre_prior"):
            _check(0 < getattr(self, name) < 1, name, getattr(self, name), "between 0 and 1")
        _check_choices(self)


@dataclasses.dataclass(frozen=True)
class CenterPointConfig(Config):
    """All that defines a CenterPoint and its training; ``model`` and the rounds of ``projection`` are ignored.

    >>> CenterPointConfig(classes=("car", "cyclist")).class_groups
    (0, 0)
    """

    pillars: PillarConfig = PillarConfig()  # Pillars, network and targets.

    def __post_init__(self) -> None:
        super().__post_init__()
        groups, names = self.pillars.groups, self.classes
        _check(
            len(groups) in (0, len(names)), "pillars.groups", groups, f"{len(names)} values, one a class, or none"
        )
        _check(self.model == ModelConfig(), "model", "choices", "none: pillars takes its place")
        for name in _RANGE_VIEW_LOSSES:
            own, default = getattr(self.loss, name), getattr(LossConfig(), name)
            _check(own == default, f"loss.{name}", own, f"{default!r} with pillars, which do not use it")
        exponent = self.inference.iou_exponent
        _check(exponent == 1, "inference.iou_exponent", exponent, "1 with pillars, which predict no IoU")

    def build(self, sensor: Sensor) -> Any:
        """CenterPoint for the clouds of a sensor."""
        from fcos_lidar_jax.centerpoint.detector import build  # Configurations are read without JAX.

        return build(self, sensor)

    @property
    def class_groups(self) -> tuple[int, ...]:
        """The group of heads of each class."""
        return self.pillars.groups or (0,) * len(self.classes)
