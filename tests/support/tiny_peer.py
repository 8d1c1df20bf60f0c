"""A CenterPoint so small that its step compiles in seconds."""

from tiny_run import CONFIG as OURS

from fcos_lidar_jax.centerpoint import CenterPointConfig, PillarConfig
from fcos_lidar_jax.config import ModelConfig

CONFIG = CenterPointConfig.of(
    OURS,
    model=ModelConfig(),
    pillars=PillarConfig(
        range_m=25.6,
        pillar_m=0.8,
        point_channels=(8, 8),
        backbone_blocks=(1, 1, 1),
        backbone_widths=(8, 8, 8),
        neck_channels=8,
        output_stride=2,
        head_channels=8,
    ),
)
NETWORK_OPTIONS = """
    --no-class-balanced --inference.max-detections 20 --inference.candidates-per-level 20
    --optimizer.batch-size 2 --optimizer.ema-decay 0.9 --pillars.range-m 25.6 --pillars.pillar-m 0.8
    --pillars.point-channels 8 8 --pillars.backbone-blocks 1 1 1 --pillars.backbone-widths 8 8 8
    --pillars.neck-channels 8 --pillars.output-stride 2 --pillars.head-channels 8
""".split()  # noqa: SIM905
"""Options of ``fcos-lidar train`` that reduce a CenterPoint preset to this network."""
