"""Ground truth from a file or from a data set in the nuScenes layout."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.names import BICYCLE_RACK, label_of
from fcos_lidar_jax.data.sweeps import Metres
from fcos_lidar_jax.evaluation import json_io
from fcos_lidar_jax.evaluation.boxes import (
    ATTRIBUTE_INDEX,
    LABELS,
    NO_BOXES,
    BoxColumns,
    GroundTruth,
    heading_yaw,
    join,
    make_columns,
)
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.geometry import rotation_matrix

_RACK = -1  # temporary label of bicycle racks


class Box(json_io.JsonBox, gc=False):
    """One annotation in the global frame."""

    num_pts: Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]


class Sample(msgspec.Struct, gc=False):
    """Annotations of one keyframe."""

    ego_translation: tuple[Metres, Metres, Metres]
    boxes: list[Box]


def read_truth(source: str | Path | dict[str, Any]) -> GroundTruth:
    """Ground truth ``{sample_token: {"ego_translation", "boxes"}}``, as a JSON file or its content."""
    raw, name = json_io.read_source(source, msgspec.Raw, given="ground truth")
    ego, parts, rotations = dict[str, json_io.Vector](), [NO_BOXES], [np.zeros((0, 4))]
    for row, (token, sample) in enumerate(json_io.decode_samples(raw, Sample, name)):
        boxes, where = sample.boxes, f"{name}: sample {token}"
        ego[token] = sample.ego_translation
        label = json_io.index_of(boxes, "detection_name", {**LABELS, BICYCLE_RACK: _RACK}, where)
        attribute = json_io.index_of(boxes, "attribute_name", ATTRIBUTE_INDEX, where)
        points = np.array([box.num_pts for box in boxes], np.int64)
        json_io.expect(points >= -1, boxes, "num_pts", where, "a count, or -1 for unknown")
        columns, rotation = json_io.geometry(boxes, where)
        parts.append(make_columns(sample=row, label=label, attribute=attribute, num_points=points, **columns))
        rotations.append(rotation)
    if not ego:
        raise ValueError(f"{name}: got no samples, expected at least one")
    return _ground_truth(ego, list(ego.values()), join(parts), np.concatenate(rotations))


def _ground_truth(tokens: Any, ego: Sequence[Any], boxes: BoxColumns, rotation: np.ndarray) -> GroundTruth:
    """Separate bicycle racks from the other boxes."""
    rack = boxes.label == _RACK
    axes, where = rotation_matrix(rotation[rack]), np.array(ego).reshape(-1, 3)
    return GroundTruth(tuple(tokens), where, boxes.take(~rack), boxes.take(rack), axes)


def split_truth(data: NuScenes, tokens: Sequence[str]) -> GroundTruth:
    """Ground truth of keyframes: boxes of the ten classes, with the benchmark's attributes, and bicycle racks."""
    index = data.index
    own = [data.annotations(token) for token in tokens]
    rows = np.concatenate([np.arange(part.start, part.stop) for part in own])
    sample = np.repeat(np.arange(len(tokens)), [part.stop - part.start for part in own])
    names = [str(name) for name in index.category_name]
    used = np.array([label_of(name) >= 0 or name == BICYCLE_RACK for name in names], bool)
    kept = used[index.box_category[rows]]
    rows, sample = rows[kept], sample[kept]
    attributes = [*map(str, index.attribute_name), ""]  # the last entry is for index -1
    for name in (attributes[i] for i in np.unique(index.box_attribute[rows])):
        check(name in ATTRIBUTE_INDEX, f"{data.tables / 'attribute.json'}: name", name, "a known attribute")
    boxes = make_columns(
        sample=sample,
        label=np.array([label_of(name) for name in names])[index.box_category[rows]],  # -1 for a rack
        translation=index.box_translation[rows],
        size=index.box_size[rows],
        yaw=heading_yaw(index.box_rotation[rows]),
        velocity=index.box_velocity[rows, :2],
        attribute=np.array([ATTRIBUTE_INDEX.get(name, -1) for name in attributes])[index.box_attribute[rows]],
        num_points=index.box_lidar_points[rows] + index.box_radar_points[rows],
    )
    ego = [data.ego_translation(token) for token in tokens]
    return _ground_truth(tokens, ego, boxes, index.box_rotation[rows])
