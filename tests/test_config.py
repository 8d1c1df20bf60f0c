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
from fcos_lidar_jax.presets import (
    ABOUT,
    COMPACT,
    KITTI,
    KITTI_COMPACT,
    NUSCENES,
    NUSCENES_SINGLE,
    NUSCENES_TEST,
    PRESETS,
    QUICKSTART,
)
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
    assert NUSCENES_SINGLE.num_sweeps == 1
    assert NUSCENES_SINGLE.projection == NUSCENES.projection
    assert (NUSCENES_TEST.model.head_channels, NUSCENES_TEST.fade_epochs) == (128, 5)


COMPACT_METHODS = (
    ("model", "circular_width"),
    ("model", "regression_axes"),
    ("model", "local_geometry"),
    ("inference", "merge_iou"),
)


@pytest.mark.parametrize(
    ("preset", "large", "own"),
    [
        (QUICKSTART, NUSCENES, ()),
        (COMPACT, NUSCENES, COMPACT_METHODS),
        (KITTI_COMPACT, KITTI, COMPACT_METHODS),
    ],
)
def test_small_presets_differ_in_numbers_only(preset, large, own):
    def kinds(value):
        if dataclasses.is_dataclass(value):
            return {f.name: kinds(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return value if isinstance(value, bool | str) else type(value)

    small, full = kinds(preset), kinds(large)
    for record in (small, full):
        del record["name"], record["sensor"]
        del record["refinement"]
        del record["projection"]["remove_close"]  # as the shipped weights were trained
        for part, name in own:
            del record[part][name]
    assert small == full


def test_only_compact_looks_at_its_boxes_again():
    assert [name for name, preset in PRESETS.items() if preset.refinement is not None] == ["compact"]
    assert COMPACT.refinement == RefinementConfig()


def test_kitti_compact_has_the_data_of_kitti_and_the_network_of_compact():
    of_data = ("classes", "max_points", "max_boxes", "class_balanced", "num_sweeps", "copy_paste")
    assert [getattr(KITTI_COMPACT, name) for name in of_data] == [getattr(KITTI, name) for name in of_data]
    scaled = dataclasses.replace(
        COMPACT.model,
        circular_width=False,
        channel_mean=KITTI.model.channel_mean,
        channel_scale=KITTI.model.channel_scale,
    )
    assert KITTI_COMPACT.model == scaled
    check_augmentation(KITTI_COMPACT.augment, load_sensor(KITTI_COMPACT.sensor))  # stays in the camera's sector
    assert KITTI_COMPACT.sensor == "kitti_camera"
    assert (KITTI_COMPACT.optimizer, KITTI_COMPACT.inference) == (COMPACT.optimizer, COMPACT.inference)


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
        (("model", "fpn_channels"), 1.5, "run: model.fpn_channels: got 1.5, expected int"),
        (("model", "backbone_blocks"), [1, 2], r"run: model.backbone_blocks: got 2 values, expected 4"),
        (("model", "stem"), 3, "run: model.stem: got int, expected a JSON object"),
        (("model", "stem", "dilations"), [0], "run: model.stem.dilations"),
        (("loss", "weight"), 1, "run: loss.weight: unknown field"),
        (("optimizer", "epochs"), 0, "run: optimizer.epochs: got 0"),
        (("num_sweeps",), True, "run: num_sweeps: got True, expected int"),
        (("augment", "scale_range"), [1.05, 0.95], "run: augment.scale_range"),
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
        lambda: StemConfig(num_convs=0),
        lambda: StemConfig(groups="all", group_rounds=False),
        lambda: ModelConfig(background_prior=1.0),
        lambda: ModelConfig(channel_scale=(0.0,) * 9),
        lambda: ModelConfig(row_upscale=0),
        lambda: ModelConfig(head_channels=0),
        lambda: ModelConfig(head_channels=33),
        lambda: ModelConfig(fpn_channels=0),
        lambda: ModelConfig(backbone_widths=(16, 0, 16, 16)),
        lambda: StemConfig(channels_per_type=0),
        lambda: StemConfig(out_channels=0),
        lambda: LossConfig(l1_weight=-1),
        lambda: LossConfig(iou_loss="l2"),  # type: ignore[arg-type]
        lambda: Config(model=ModelConfig(stem=StemConfig(group_rounds=False, channels_per_type=4))),  # five rounds
        lambda: LossConfig(centreness_m=2.0),  # of no use: the factor is trained to be the IoU
        lambda: RefinementConfig(num_boxes=0),
        lambda: RefinementConfig(point_channels=()),
        lambda: RefinementConfig(first_score_weight=1.5),
        lambda: RefinementConfig(radius_range_m=(2.0, 1.0)),
        lambda: InferenceConfig(iou_threshold=2),
        lambda: InferenceConfig(nms_overlap="4d"),  # type: ignore[arg-type]
        lambda: InferenceConfig(iou_exponent=-0.5),
        lambda: InferenceConfig(iou_exponent=float("inf")),
        lambda: AugmentConfig(flip_x_probability=2),
        lambda: AugmentConfig(scale_range=(1.0, float("inf"))),
        lambda: OptimizerConfig(warmup_fraction=1.0),
        lambda: OptimizerConfig(initial_divisor=0.0),
        lambda: OptimizerConfig(final_divisor=0.0),
        lambda: OptimizerConfig(peak_learning_rate=float("inf")),
        lambda: OptimizerConfig(max_gradient_norm=0.0),
        lambda: OptimizerConfig(weight_decay=-1.0),
        lambda: OptimizerConfig(b1_range=(0.0, 0.9)),
        lambda: OptimizerConfig(b2=1.0),
        lambda: Config(max_points=0),
        lambda: Config(classes=()),
        lambda: Config(classes=("crate", "crate")),
        lambda: Config(classes=["crate"]),  # type: ignore[arg-type]
        lambda: Config(augment=AugmentConfig(scale_range=[0.9, 1.1])),  # type: ignore[arg-type]
        lambda: Config(class_ranges_m=(50.0,)),
        lambda: Config(copy_paste=CopyPasteConfig(targets=(2, 2))).paste_targets,
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


def test_the_papers_presets_keep_close_points_of_the_current_sweep():
    """Which gives its numbers of points; the presets of the shipped weights do without them."""
    modes = {name: preset.projection.remove_close for name, preset in PRESETS.items()}
    assert modes == dict.fromkeys(PRESETS, "sweeps") | dict.fromkeys(
        ("compact", "kitti_compact", "centerpoint_compact", "quickstart"), "all"
    )


@pytest.mark.parametrize(
    ("kind", "field", "value", "expected"),
    [
        (ProjectionConfig, "num_rounds", 2.5, "int"),
        (ProjectionConfig, "num_rounds", "5", "int"),
        (ProjectionConfig, "prioritize_current", 1, "bool"),
        (LossConfig, "top_q", True, "int"),
        (LossConfig, "l1_weight", None, "float"),
        (LossConfig, "iou_loss", "ciou", "one of 'iou', 'log_iou', 'giou', 'diou'"),
        (InferenceConfig, "merge_iou", "0.5", "float or None"),
        (StemConfig, "dilations", (1, 2.0), "a tuple of int"),
        (StemConfig, "dilations", [1, 2], "a tuple of int"),
        (Config, "loss", None, "LossConfig"),
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
