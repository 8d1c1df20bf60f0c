"""Named configurations: the paper's detectors, and small ones for first steps and tests."""

import dataclasses
import math

from fcos_lidar_jax.centerpoint import CenterPointConfig, PillarConfig
from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES, KITTI_CLASSES
from fcos_lidar_jax.config import (
    AugmentConfig,
    Config,
    CopyPasteConfig,
    InferenceConfig,
    LossConfig,
    OptimizerConfig,
    ProjectionConfig,
    RefinementConfig,
    StemConfig,
)

NUSCENES = Config()
"""The paper's detector: ten sweeps, five rounds."""

NUSCENES_SINGLE = dataclasses.replace(NUSCENES, name="nuscenes_single", num_sweeps=1, max_points=40_000)
"""The paper's single-frame detector: the same network and five rounds on one sweep."""

NUSCENES_TEST = dataclasses.replace(
    NUSCENES, name="nuscenes_test", fade_epochs=5, model=dataclasses.replace(NUSCENES.model, head_channels=128)
)
"""The paper's test-set model "c128" (section 4.5): wider heads, fade strategy."""

KITTI = dataclasses.replace(
    NUSCENES_SINGLE,
    name="kitti",
    sensor="kitti_hdl64e",
    classes=KITTI_CLASSES,
    max_points=131_072,
    max_boxes=64,
    class_balanced=False,
    # With 64 beams the rows need no doubling.
    model=dataclasses.replace(
        NUSCENES.model,
        row_upscale=1,
        channel_mean=(10.9, 0.0, -1.04, 12.1, 0.0, -0.15, 53.6, 0.0, 0.0),
        channel_scale=(11.5, 6.9, 0.86, 12.3, 0.4, 0.13, 40.8, 1.0, 0.144),
    ),
    # Labels and points are limited to the camera's view ahead: rotations must not leave it.
    augment=AugmentConfig(flip_x_probability=0.0, max_rotation_rad=math.pi / 4),
)
"""KITTI: one sweep, the camera's view, three classes. The means and scales of the channels are the usual ones for
this view; the angles' are nominal."""

ARGOVERSE2 = dataclasses.replace(
    NUSCENES_SINGLE,
    name="argoverse2",
    sensor="argoverse2",
    classes=ARGOVERSE2_CLASSES,
    max_points=131_072,
    model=dataclasses.replace(
        NUSCENES.model,
        row_upscale=1,
        channel_mean=(0.0, 0.0, 0.75, 14.0, 0.0, -0.14, 17.5, 0.0, 0.0),
        channel_scale=(14.0, 14.0, 1.3, 13.0, 1.8, 0.17, 17.6, 1.0, 0.144),
    ),
)
"""Argoverse 2's sensor data set: one sweep of both LiDARs, 26 classes. The means and scales of the channels were
measured on simulated frames."""

QUICKSTART = dataclasses.replace(
    NUSCENES,
    name="quickstart",
    sensor="short_range",
    num_sweeps=1,
    max_points=4096,
    max_boxes=32,
    copy_paste=CopyPasteConfig(targets=(2, 1, 1, 1, 1, 2, 1, 1, 1, 1)),
    projection=ProjectionConfig(num_rounds=1, remove_close="all"),
    model=dataclasses.replace(
        NUSCENES.model,
        row_upscale=1,
        stem=StemConfig(channels_per_type=4, out_channels=16, dilations=(1, 3)),
        backbone_blocks=(2, 2, 1, 1),
        backbone_widths=(16, 32, 32, 32),
        fpn_channels=32,
        head_channels=32,
        head_convs=2,
    ),
    optimizer=OptimizerConfig(peak_learning_rate=3e-3, batch_size=2),
)
"""The same code with smaller numbers, to train on two CPU cores."""

COMPACT = dataclasses.replace(
    NUSCENES_SINGLE,
    name="compact",
    max_boxes=200,
    projection=ProjectionConfig(num_rounds=1, remove_close="all"),
    model=dataclasses.replace(
        NUSCENES.model,
        row_upscale=1,
        circular_width=True,
        regression_axes="ray",
        local_geometry=True,
        stem=StemConfig(channels_per_type=4, out_channels=32, dilations=(1, 3)),
        backbone_blocks=(3, 3, 3, 2),
        backbone_widths=(32, 48, 64, 64),
        fpn_channels=64,
        head_channels=48,
        head_convs=2,
    ),
    # With the paper's 0.25, a nearly square object can stay rotated by 90 degrees with its sides swapped: its IoU
    # is perfect, and only the L1 loss penalises it.
    loss=LossConfig(l1_weight=1.0),
    # Objects do not overlap on the ground, so overlapping boxes mostly estimate the same object.
    inference=InferenceConfig(iou_threshold=0.1, iou_exponent=0.5, merge_iou=0.1),
    refinement=RefinementConfig(),
    # Streets mostly run in the driving direction, in training as in detection.
    augment=AugmentConfig(max_rotation_rad=math.pi / 8),
    optimizer=OptimizerConfig(peak_learning_rate=3e-3, batch_size=1, ema_decay=0.998),
)
"""One sweep of nuScenes' sensor on two CPU cores: the paper's architecture with a fifth of its parameters.

Layers at stride 1 cost most, so they are narrower than the later ones. When more training no longer helped, stem,
first stage, pyramid and heads were widened, and the first stage got a third block (``experiments/LOG.md``,
2026-11-27). Doubled rows contain the same points. The image wraps around, so there is no seam behind the vehicle.
NMS at 0.1, weighted NMS, the IoU exponent, the regression axes and the second look are not in the paper;
``experiments/LOG.md`` has what each adds.
"""

KITTI_COMPACT = dataclasses.replace(
    KITTI,
    name="kitti_compact",
    sensor="kitti_camera",
    refinement=None,
    **{part: getattr(COMPACT, part) for part in ("projection", "loss", "inference", "optimizer")},
    model=dataclasses.replace(
        COMPACT.model,
        circular_width=False,
        channel_mean=KITTI.model.channel_mean,
        channel_scale=KITTI.model.channel_scale,
    ),
    # The camera sees 81 degrees, the image has 90.
    augment=AugmentConfig(flip_x_probability=0.0, max_rotation_rad=math.radians(4)),
)
"""The network, losses and post-processing of ``compact`` for KITTI's camera view, a quarter of the image."""

CENTERPOINT_PILLARS = CenterPointConfig.of(
    NUSCENES,
    name="centerpoint_pillars",
    copy_paste=None,
    # Cars; trucks, construction vehicles; buses, trailers; barriers; cycles; pedestrians, cones.
    pillars=PillarConfig(groups=(0, 1, 2, 2, 1, 5, 4, 4, 5, 3)),
    inference=InferenceConfig(min_probability=0.1),
    augment=AugmentConfig(max_rotation_rad=math.pi / 8),
    optimizer=OptimizerConfig(peak_learning_rate=1e-3, epochs=20),
)
"""CenterPoint on pillars with its authors' values for nuScenes: ten sweeps, pillars of 0.2 m."""

CENTERPOINT_COMPACT = CenterPointConfig.of(
    COMPACT,
    name="centerpoint_compact",
    model=NUSCENES.model,
    loss=NUSCENES.loss,
    inference=dataclasses.replace(COMPACT.inference, iou_exponent=1.0),
    refinement=None,
    pillars=PillarConfig(
        pillar_m=0.4,
        point_channels=(32,),
        backbone_blocks=(3, 4, 4),
        backbone_widths=(32, 64, 96),
        neck_channels=32,
        output_stride=2,
        head_channels=32,
    ),
)
"""CenterPoint for comparison with ``compact``: the same sweep, augmentation, optimizer and post-processing, with
pillars of 0.4 m and 0.4 times the parameters. All classes are one group: rare classes share features with frequent
ones."""

PRESETS: dict[str, Config] = {
    c.name: c
    for c in (
        *(NUSCENES, NUSCENES_SINGLE, NUSCENES_TEST, KITTI, ARGOVERSE2, COMPACT, KITTI_COMPACT),
        *(QUICKSTART, CENTERPOINT_PILLARS, CENTERPOINT_COMPACT),
    )
}
"""Configurations by name."""

ABOUT = {
    "nuscenes": "the paper's detector on ten sweeps",
    "nuscenes_single": "the paper's detector on one sweep",
    "nuscenes_test": "the paper's test-set model",
    "kitti": "one sweep of KITTI's camera view, three classes",
    "argoverse2": "one sweep of Argoverse 2, 26 classes",
    "compact": "a smaller network on one sweep of nuScenes, for two CPU cores",
    "kitti_compact": "the network of compact for KITTI, without trained weights",
    "quickstart": "smaller still, for a short-range sensor and tests",
    "centerpoint_pillars": "CenterPoint on ten sweeps, for comparison",
    "centerpoint_compact": "CenterPoint on one sweep, for comparison with compact",
}
"""Descriptions of the presets, for ``fcos-lidar train --help``."""
