"""Configuration of CenterPoint on pillars (Yin et al., CVPR 2021)."""

import dataclasses
from typing import Any, Self

from fcos_lidar_jax.centerpoint.pillar_config import PillarConfig
from fcos_lidar_jax.config import Config, LossConfig, ModelConfig
from fcos_lidar_jax.fields import check, check_per_class
from fcos_lidar_jax.sensors import Sensor

_RANGE_VIEW_LOSSES = (
    *("top_q", "regress_on", "iou_loss", "iou_weight", "iou_prediction_weight"),
    *("quality", "centreness_m"),
)
"""Fields of :class:`LossConfig` that CenterPoint does not use."""


@dataclasses.dataclass(frozen=True)
class CenterPointConfig(Config):
    """Definition of a CenterPoint detector and its training, without the data.

    Rounds and priority of ``projection`` are ignored.
    """

    pillars: PillarConfig = PillarConfig()  # Pillars, network and targets.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_per_class("pillars.groups", self.pillars.groups, self.classes)
        check(self.model == ModelConfig(), "model", "changes", "the default: pillars takes its place")
        unused = [
            (f"loss.{name}", getattr(self.loss, name), getattr(LossConfig(), name)) for name in _RANGE_VIEW_LOSSES
        ]
        for name, own, default in (*unused, ("inference.iou_exponent", self.inference.iou_exponent, 1.0)):
            check(own == default, name, own, f"{default!r} with pillars, which do not use it")

    def with_doubled_classes(self, **changes: Any) -> Self:
        doubled = dataclasses.replace(self.pillars, groups=2 * self.pillars.groups)
        return super().with_doubled_classes(pillars=doubled, **changes)

    def build(self, sensor: Sensor) -> Any:
        """Build CenterPoint for the clouds of a sensor."""
        from fcos_lidar_jax.centerpoint.detector import build  # Reading a configuration must not import JAX.

        return build(self, self.pillars, sensor)
