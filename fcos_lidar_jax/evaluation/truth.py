"""Ground truth for the metric, from a file or from a data set in the nuScenes layout."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.names import BICYCLE_RACK, label_of
from fcos_lidar_jax.evaluation.boxes import (
    ATTRIBUTE_INDEX,
    LABELS,
    NO_BOXES,
    NO_RACKS,
    UNKNOWN_POINTS,
    BoxColumns,
    GroundTruth,
    Racks,
    heading_yaw,
    join,
    make_columns,
)
from fcos_lidar_jax.evaluation.json_io import decode_json, decode_samples, encode_json, read_json, split_samples
from fcos_lidar_jax.evaluation.results import Quaternion, Vector, Velocity, expect, geometry
from fcos_lidar_jax.geometry import rotation_matrix

_RACK, _OTHER = -1, -2
"""Labels of bicycle racks, while they are among the boxes, and of what nobody knows."""


class Box(msgspec.Struct, gc=False):
    """One annotation in the global frame."""

    translation: Vector
    size: Vector
    rotation: Quaternion
    velocity: Velocity
    detection_name: str
    attribute_name: str
    num_pts: int


class Sample(msgspec.Struct, gc=False):
    """What is at one keyframe."""

    ego_translation: Vector
    boxes: list[Box]


def read_truth(source: str | Path | dict[str, Any]) -> GroundTruth:
    """Ground truth as ``{sample_token: {"ego_translation", "boxes"}}``.

    Args:
        source: the JSON file, or what ``json.load`` gives for it.

    Raises:
        ValueError: naming the file, the sample, the box (from 0) and the field.
    """
    given = isinstance(source, dict)
    name = "ground truth" if given else str(source)
    raw = decode_json(encode_json(source) if given else read_json(source), msgspec.Raw, name)
    tokens: list[str] = []
    ego: list[Vector] = []
    boxes, racks = [NO_BOXES], [NO_RACKS]
    for row, (token, sample) in enumerate(decode_samples(split_samples(raw, name), Sample, name)):
        if not np.isfinite(sample.ego_translation).all():
            got = f"got {list(sample.ego_translation)}, expected three finite numbers"
            raise ValueError(f"{name}: sample {token}: ego_translation: {got}")
        tokens.append(token)
        ego.append(sample.ego_translation)
        own_boxes, own_racks = _columns(row, sample.boxes, f"{name}: sample {token}")
        boxes.append(own_boxes)
        racks.append(own_racks)
    if not tokens:
        raise ValueError(f"{name}: got no sample, expected at least one")
    return GroundTruth(tuple(tokens), np.array(ego), join(boxes), join(racks))


def _columns(sample: int, boxes: list[Box], where: str) -> tuple[BoxColumns, Racks]:
    names = np.array([box.detection_name for box in boxes])
    attributes = np.array([box.attribute_name for box in boxes])
    points = np.array([box.num_pts for box in boxes])
    label = np.array([_RACK if name == BICYCLE_RACK else LABELS.get(str(name), _OTHER) for name in names], int)
    attribute = np.array([ATTRIBUTE_INDEX.get(str(name), _OTHER) for name in attributes], int)
    expect(where, "detection_name", names, label > _OTHER, f"one of {', '.join(LABELS)}, {BICYCLE_RACK}")
    known = ", ".join(filter(None, ATTRIBUTE_INDEX))
    expect(where, "attribute_name", attributes, attribute > _OTHER, f"one of {known} or nothing")
    expect(where, "num_pts", points, points >= UNKNOWN_POINTS, "a count, or -1 for unknown")
    columns, rotation = geometry(boxes, where)
    every = make_columns(sample=sample, label=label, attribute=attribute, num_points=points, **columns)
    return _split_racks(every, rotation)


def _split_racks(boxes: BoxColumns, rotation: np.ndarray) -> tuple[BoxColumns, Racks]:
    """Boxes of the ten classes, and racks."""
    rack = boxes.label == _RACK
    racks = boxes.take(rack)
    return boxes.take(~rack), Racks(racks.sample, racks.translation, racks.size, rotation_matrix(rotation[rack]))


def split_truth(data: NuScenes, tokens: Sequence[str]) -> GroundTruth:
    """Ground truth of some keyframes, those of the ten classes and the bicycle racks.

    Args:
        data: the data set.
        tokens: keyframes.

    Raises:
        ValueError: an attribute that the benchmark does not know.
    """
    index = data.index
    own = [data.annotations(token) for token in tokens]
    rows = np.concatenate([np.arange(part.start, part.stop) for part in own])
    sample = np.repeat(np.arange(len(tokens)), [part.stop - part.start for part in own])
    names = [str(name) for name in index.category_name]
    wanted = np.array([_RACK if name == BICYCLE_RACK else label_of(name) for name in names], np.int64)
    counted = np.array([label_of(name) >= 0 or name == BICYCLE_RACK for name in names], bool)
    kept = counted[index.box_category[rows]]
    rows, sample = rows[kept], sample[kept]
    for used in np.unique(index.box_attribute[rows]):
        name = str(index.attribute_name[used]) if used >= 0 else ""
        if name not in ATTRIBUTE_INDEX:
            raise ValueError(f"{data.tables / 'attribute.json'}: name: got {name!r}, expected a known attribute")
    attribute = np.array([ATTRIBUTE_INDEX.get(str(name), -1) for name in index.attribute_name] + [-1])
    every = make_columns(
        sample=sample,
        label=wanted[index.box_category[rows]],
        translation=index.box_translation[rows],
        size=index.box_size[rows],
        yaw=heading_yaw(index.box_rotation[rows]),
        velocity=index.box_velocity[rows, :2],
        attribute=attribute[index.box_attribute[rows]],
        num_points=index.box_lidar_points[rows] + index.box_radar_points[rows],
    )
    boxes, racks = _split_racks(every, index.box_rotation[rows])
    ego = np.array([data.ego_translation(token) for token in tokens]).reshape(-1, 3)
    return GroundTruth(tuple(tokens), ego, boxes, racks)
