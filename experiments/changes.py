"""Changes of configurations."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from fcos_lidar_jax.centerpoint import CenterPointConfig
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT, COMPACT, NUSCENES

Change = Callable[[Config], Config]


def change(**fields: Any) -> Change:
    """Make a function that replaces fields of a configuration; double underscores stand for dots.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> change(projection__num_rounds=3, num_sweeps=1)(QUICKSTART).projection.num_rounds
    3
    """

    def apply(config: Config) -> Config:
        for path, value in fields.items():
            config = _replaced(config, path.split("__"), value)
        return config

    return apply


def _replaced(config: Any, path: list[str], value: Any) -> Any:
    first, *rest = path
    inner = _replaced(getattr(config, first), rest, value) if rest else value
    return dataclasses.replace(config, **{first: inner})


def as_centerpoint(config: Config) -> CenterPointConfig:
    """CenterPoint with the sizes of its compact preset, and data and training of a configuration."""
    own = {part: getattr(CENTERPOINT_COMPACT, part) for part in ("model", "loss", "pillars")}
    # Candidates of the range view on all levels; the coarsest have less than 1000 each.
    shared = change(inference__iou_exponent=1.0, inference__candidates_per_level=4450)
    return CenterPointConfig.of(shared(config), **own)


SLIM = change(
    refinement=None,
    model__stem__out_channels=16,
    model__backbone_blocks=(2, 3, 3, 2),
    model__backbone_widths=(16, 48, 64, 64),
    model__fpn_channels=48,
    model__head_channels=32,
)
"""Sizes of ``compact`` before 2026-11-27, without its second look. The ladder and the scale ``sector`` keep them,
so that trials stay comparable."""
BONNET_M = 2.1  # Nearer points are on the bonnet of the ego vehicle, which leaves a trail in fused sweeps.
AHEAD = {
    "max_boxes": 64,
    "copy_paste": None,
    "class_balanced": False,
    "projection": dataclasses.replace(NUSCENES.projection, remove_close="all", close_m=BONNET_M),
    "model__circular_width": False,
    # Larger rotations leave the sector, and a mirrored street would face backwards.
    "augment__flip_y_probability": 0.0,
    "augment__max_rotation_rad": math.radians(5),
}
"""Fields for the forward quarter of the view of nuScenes' sensor."""
LARGER = {
    "model__stem__out_channels": COMPACT.model.stem.out_channels,
    **{
        f"model__{name}": getattr(COMPACT.model, name)
        for name in ("backbone_blocks", "backbone_widths", "fpn_channels", "head_channels")
    },
}
"""Fields that return to the sizes of ``compact`` today."""
assert COMPACT.refinement is not None
QUARTER_LOOK = dataclasses.replace(COMPACT.refinement, num_boxes=64)
"""The second look of ``compact`` for as many boxes as a quarter of the view has."""
LONE_LOOK = dataclasses.replace(QUARTER_LOOK, num_neighbours=0)
"""The same without the comparison of neighbours, as it was before 2026-11-29."""
FROZEN_LOOK = dataclasses.replace(QUARTER_LOOK, freeze_detector=True)
"""The second look of tables: trained afterwards, on the boxes of the frozen detector."""
