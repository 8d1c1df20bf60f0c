"""Configurations: presets, JSON there and back, and one line for nonsense."""

import dataclasses
import functools
import json
import re

import pytest

from fcos_lidar_jax.augment import check_augmentation
from fcos_lidar_jax.config import (
    AugmentConfig,
    Config,
    CopyPasteConfig,
    InferenceConfig,
    LossConfig,
    ModelConfig,
    OptimizerConfig,
    ProjectionConfig,
    RefinementConfig,
    StemConfig,
    config_from_json,
    config_to_json,
)
from fcos_lidar_jax.presets import ABOUT, NUSCENES, NUSCENES_SINGLE, NUSCENES_TEST, PRESETS
from fcos_lidar_jax.sensors import load_sensor

MISSING = object()


def test_presets_are_the_papers():
    projection = NUSCENES.projection
    assert (NUSCENES.num_sweeps, projection.num_rounds, projection.prioritize_current) == (10, 5, True)
    assert NUSCENES.model.backbone_blocks == (4, 4, 1, 1)
    assert NUSCENES.model.backbone_widths == (64, 128, 128, 128)
    assert NUSCENES.model.stem == StemConfig("types", True, 2, (1, 3, 6), 32, 64)
    assert (NUSCENES.inference.min_probability, NUSCENES.inference.iou_threshold) == (0.01, 0.2)
    assert (NUSCENES.inference.max_detections, NUSCENES.loss.top_q) == (500, 20)
    assert (NUSCENES.optimizer.epochs, NUSCENES.optimizer.weight_decay) == (40, 0.01)
    assert (projection.remove_close, projection.close_m) == ("sweeps", 1.0)  # gives the paper's numbers of points
    assert NUSCENES_SINGLE.num_sweeps == 1
    assert NUSCENES_SINGLE.projection == NUSCENES.projection
    assert (NUSCENES_TEST.model.head_channels, NUSCENES_TEST.fade_epochs) == (128, 5)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_the_augmentation_of_a_preset_suits_its_sensor(preset):
    check_augmentation(preset.augment, load_sensor(preset.sensor))


def test_every_preset_has_one_line_about_it():
    assert list(ABOUT) == list(PRESETS)
    assert all(0 < len(line) < 80 and "\n" not in line for line in ABOUT.values())


@pytest.mark.parametrize("name", PRESETS)
def test_json_gives_back_the_configuration(name):
    text = json.dumps(config_to_json(PRESETS[name]))
    assert config_from_json(json.loads(text)) == PRESETS[name]
    still = dataclasses.replace(PRESETS[name], augment=None)
    assert config_from_json(json.loads(json.dumps(config_to_json(still)))) == still
    assert hash(still) != hash(PRESETS[name])


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("model", "stem", "groups"), "colours", "run: model.stem.groups: got 'colours', expected one of 'types'"),
        (("model", "fpn_channels"), "wide", "run: model.fpn_channels: got 'wide', expected int"),
        (("model", "backbone_blocks"), [1, 2], r"run: model.backbone_blocks: got .*, expected a tuple of 4 int"),
        (("model", "stem"), 3, "run: model.stem: got int, expected a JSON object"),
        (("loss", "weight"), 1, "run: loss.weight: unknown field"),
        (("num_sweeps",), True, "run: num_sweeps: got True, expected int"),
        (("augment", "scale_range"), [1.05, 0.95], "run: augment.scale_range: got .*, expected ascending numbers"),
        (("loss",), MISSING, r"run: loss: missing"),
        (("loss", "l1_weight"), 10**400, r"run: loss\.l1_weight: got 1000"),
    ],
)
def test_bad_json_gets_one_line_with_the_field(path, value, message):
    record = json.loads(json.dumps(config_to_json(NUSCENES)))
    place = functools.reduce(dict.__getitem__, path[:-1], record)
    place[path[-1]] = value
    if value is MISSING:
        del place[path[-1]]
    with pytest.raises(ValueError, match=message):
        config_from_json(record, "run")


@pytest.mark.parametrize(
    "make",
    [
        lambda: ProjectionConfig(num_rounds=0),
        lambda: ProjectionConfig(close_m=0),
        lambda: StemConfig(groups="all", group_rounds=False),
        lambda: ModelConfig(background_prior=1.0),
        lambda: ModelConfig(channel_scale=(0.0,) * 9),
        lambda: ModelConfig(channel_scale=(1.0,) * 8),
        lambda: ModelConfig(head_channels=33),
        lambda: ModelConfig(backbone_widths=(16, 0, 16, 16)),
        lambda: ModelConfig(round_offsets=True),
        lambda: LossConfig(centreness_m=2.0),  # of no use: the factor is trained to be the IoU
        lambda: RefinementConfig(point_channels=()),
        lambda: InferenceConfig(iou_threshold=2),
        lambda: InferenceConfig(iou_exponent=float("inf")),
        lambda: AugmentConfig(scale_range=(1.0, float("inf"))),
        lambda: OptimizerConfig(b1_range=(0.0, 0.9)),
        lambda: OptimizerConfig(b2=1.0),
        lambda: Config(model=ModelConfig(stem=StemConfig(group_rounds=False, channels_per_type=4))),  # five rounds
        lambda: Config(classes=()),
        lambda: Config(classes=("crate", "crate")),
        lambda: Config(class_ranges_m=(50.0,)),
        lambda: Config(copy_paste=CopyPasteConfig(targets=(2, 2))).paste_targets,
        lambda: Config(augment=None, inference=InferenceConfig(flips="x")),
        lambda: Config(augment=AugmentConfig(flip_y_probability=0.0), inference=InferenceConfig(flips="xy")),
    ],
)
def test_nonsense_is_refused_at_construction(make):
    with pytest.raises(ValueError, match="got"):
        make()


def test_what_follows_from_the_names_of_the_classes_and_what_is_given():
    own = Config(classes=("crate", "pedestrian"))
    assert own.ranges_m == {"crate": 50.0, "pedestrian": 40.0}
    assert own.paste_targets == (2, 2)
    assert NUSCENES.paste_targets == (2, 3, 4, 6, 7, 2, 6, 6, 2, 2)
    given = Config(
        classes=("crate", "pedestrian"), class_ranges_m=(9.0, 8.0), copy_paste=CopyPasteConfig(targets=(1, 5))
    )
    assert (given.ranges_m, given.paste_targets) == ({"crate": 9.0, "pedestrian": 8.0}, (1, 5))
    assert Config(copy_paste=None).paste_targets == (0,) * 10


@pytest.mark.parametrize(
    ("kind", "field", "value", "expected"),
    [
        (ProjectionConfig, "num_rounds", 2.5, "int"),
        (ProjectionConfig, "prioritize_current", 1, "bool"),
        (LossConfig, "top_q", True, "int"),
        (LossConfig, "iou_loss", "ciou", "one of 'iou', 'log_iou', 'giou', 'diou'"),
        (InferenceConfig, "merge_iou", "0.5", "float or None"),
        (StemConfig, "dilations", (1, 2.0), "a tuple of int"),
        (StemConfig, "dilations", [1, 2], "a tuple of int"),
        (Config, "projection", {"num_rounds": 1}, "ProjectionConfig"),
        (Config, "augment", False, "AugmentConfig or None"),
    ],
)
def test_a_value_of_another_type_is_refused(kind, field, value, expected):
    message = re.escape(f"{field}: got {value!r}, expected {expected}")
    with pytest.raises(ValueError, match=f"^{message}$"):
        dataclasses.replace(kind(), **{field: value})


def test_integers_are_accepted_as_floats():
    assert LossConfig(l1_weight=1).l1_weight == 1
