"""CenterPoint's configuration: nonsense is refused, and a file says by its fields which detector it is of."""

import json

import pytest

from fcos_lidar_jax.centerpoint import CenterPointConfig, PillarConfig
from fcos_lidar_jax.config import (
    Config,
    InferenceConfig,
    LossConfig,
    ModelConfig,
    config_from_json,
    config_to_json,
)
from fcos_lidar_jax.presets import CENTERPOINT_PILLARS, COMPACT, NUSCENES


@pytest.mark.parametrize(
    "make",
    [
        lambda: PillarConfig(pillar_m=0.3),
        lambda: PillarConfig(pillar_m=0.0),
        lambda: PillarConfig(output_stride=3),  # type: ignore[arg-type]
        lambda: PillarConfig(point_channels=()),
        lambda: PillarConfig(backbone_blocks=(-1, 5, 5)),
        lambda: PillarConfig(groups=(0, 2)),
        lambda: PillarConfig(min_overlap=1.0),
        lambda: CenterPointConfig(pillars=PillarConfig(groups=(0, 1))),
        lambda: CenterPointConfig(model=ModelConfig(tied_heads=True)),
        lambda: CenterPointConfig(inference=InferenceConfig(iou_exponent=0.5)),
        lambda: CenterPointConfig(loss=LossConfig(top_q=10)),
    ],
)
def test_nonsense_is_refused_at_construction(make):
    with pytest.raises(ValueError, match="got"):
        make()


def test_a_file_says_by_its_fields_which_detector_it_is_of():
    assert "pillars" not in config_to_json(NUSCENES)
    record = json.loads(json.dumps(config_to_json(CENTERPOINT_PILLARS)))
    assert record["pillars"]["pillar_m"] == 0.2
    assert type(config_from_json(record)) is CenterPointConfig
    with pytest.raises(ValueError, match=r"run: pillars: got NoneType, expected a JSON object"):
        config_from_json({**config_to_json(NUSCENES), "pillars": None}, "run")
    with pytest.raises(ValueError, match=r"run: pillars\.range_m: missing"):
        config_from_json({**record, "pillars": {"pillar_m": 0.2}}, "run")


def test_the_fields_that_detectors_share_go_from_one_configuration_to_another():
    peer = CenterPointConfig.of(NUSCENES, max_points=9)
    assert (peer.max_points, peer.optimizer, peer.pillars) == (9, NUSCENES.optimizer, PillarConfig())
    assert Config.of(CenterPointConfig.of(NUSCENES)) == NUSCENES != CenterPointConfig.of(NUSCENES)
    with pytest.raises(ValueError, match="model: got 'changes', expected the default"):
        CenterPointConfig.of(COMPACT)
