"""What names a result cell: an explicit list of fields, so that finished cells keep their names.

Format 1, the only one: the name is the BLAKE2b hash of 8 bytes, in hexadecimal, of the JSON text of

    [configuration, the scale's description, seed]

with sorted keys. The configuration holds :data:`FIELDS`, all fields of the first cells, read from today's
configuration; :data:`CONSTANTS` in place of first fields that are gone or never mattered; the number of classes
as ``model.num_classes``; of :data:`ADDED` those that differ from what was done before there was such a field; and
:data:`SECTIONS` that are given. A new field of ``Config`` belongs into ``LATER_FIELDS`` of
checkpoints, which is enough, or also into :data:`IGNORED` if it cannot change a result.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from flax.traverse_util import flatten_dict, unflatten_dict

from fcos_lidar_jax.checkpoints.storage import LATER_FIELDS
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import Config, config_from_json, config_to_json
from fcos_lidar_jax.sensors import Sensor

_SECTIONS = {
    "": "sensor num_sweeps max_points max_boxes fade_epochs copy_paste class_balanced augment",
    "projection": "num_rounds prioritize_current remove_close close_m",
    "copy_paste": "targets min_points",
    "model": "precision row_upscale circular_width backbone_blocks backbone_widths fpn_channels head_channels "
    "head_convs tied_heads background_prior channel_mean channel_scale",
    "model.stem": "groups group_rounds num_convs dilations channels_per_type out_channels merge",
    "loss": "top_q regress_on iou_loss classification_weight l1_weight iou_weight iou_prediction_weight "
    "velocity_weight",
    "inference": "min_probability iou_threshold max_detections candidates_per_level nms_overlap",
    "augment": "flip_x_probability flip_y_probability max_rotation_rad scale_range",
    "optimizer": "peak_learning_rate initial_divisor final_divisor warmup_fraction b1_range b2 weight_decay "
    "max_gradient_norm batch_size accumulate ema_decay epochs",
}
FIELDS = frozenset(f"{part}.{name}".strip(".") for part, names in _SECTIONS.items() for name in names.split())
"""Fields that name a cell; ``copy_paste`` and ``augment`` themselves where they are null."""
CONSTANTS = {"name": "", "model.stem.form": "split", "inference.nms_form": "rows"}
"""First fields that never changed a result."""
IGNORED = frozenset({*CONSTANTS, "model.remat"})  # Fields that cannot change a result.
_LATER = {field: value for field, value in flatten_dict(LATER_FIELDS, sep=".").items() if field not in IGNORED}
ADDED: dict[str, Any] = {"classes": NUSCENES_CLASSES, "class_ranges_m": (), **_LATER}
"""Later fields, and their values in older cells; those that checkpoints know as later ones, too."""
SECTIONS = ("pillars",)  # Later sections, of which all fields name a cell where they are given.
_SENSOR = "name inclinations_rad num_columns origin_m limit_xy_m limit_z_m intensity_scale row_source"
SENSOR_FIELDS = tuple(_SENSOR.split())  # Of a scale's description.


def cell_name(config: Config, trained_on: Mapping[str, Any], seed: int) -> str:
    """The name of a cell: configuration, the scale's description of data and length of the training, and seed.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> other = dataclasses.replace(QUICKSTART, name="another name")
    >>> cell_name(QUICKSTART, {}, 0) == cell_name(other, {}, 0) != cell_name(QUICKSTART, {}, 1)
    True
    """
    today = flatten_dict(config_to_json(config), sep=".")
    named = {field: value for field, value in today.items() if field in FIELDS}
    named |= {**CONSTANTS, "model.num_classes": len(config.classes)}
    if config.copy_paste is not None:
        named["copy_paste.targets"] = config.paste_targets
    named |= {field: today[field] for field, before in ADDED.items() if today[field] != before}
    named |= {field: value for field, value in today.items() if field.split(".")[0] in SECTIONS}
    text = json.dumps([unflatten_dict(named, sep="."), trained_on, seed], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def describe_sensor(sensor: Sensor) -> dict[str, Any]:
    """A sensor in a scale's description: the first fields, and later ones that are not at their defaults."""
    later = [f for f in dataclasses.fields(sensor) if f.name not in SENSOR_FIELDS]
    changed = [f.name for f in later if getattr(sensor, f.name) != f.default]
    return {name: getattr(sensor, name) for name in (*SENSOR_FIELDS, *changed)}


def config_of_cell(record: dict[str, Any]) -> Config:
    """The configuration in a cell's file, of whatever age.

    Raises:
        ValueError: naming the field, what was found and what was expected.
    """
    today = flatten_dict(config_to_json(Config()), sep=".")
    gone = {*CONSTANTS, "model.num_classes"} - today.keys()
    kept = {field: value for field, value in flatten_dict(record, sep=".").items() if field not in gone}
    later = {field: value for field, value in today.items() if field in IGNORED} | ADDED
    return config_from_json(unflatten_dict(later | kept, sep="."), "cell")
