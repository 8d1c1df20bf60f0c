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
    BoxColumns,
    GroundTruth,
    Racks,
    heading_yaw,
    join,
    no_racks,
    rotation_axes,
)
from fcos_lidar_jax.evaluation.documents import (
    DocumentError,
    as_document,
    by_sample,
    decode_document,
    decode_samples,
    read_document,
)
from fcos_lidar_jax.evaluation.results import Quaternion, Vector, Velocity, geometry

_RACK = -1
"""Label of a bicycle rack while it is among the boxes."""


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
        DocumentError: naming the file, the sample, the box (from 0) and the field.
    """
    given = isinstance(source, dict)
    name = "ground truth" if given else str(source)
    raw = decode_document(as_document(source) if given else read_document(source), msgspec.Raw, name)
    tokens: list[str] = []
    ego: list[Vector] = []
    parts: list[tuple[BoxColumns, Racks]] = []
    for row, (token, sample) in enumerate(decode_samples(by_sample(raw, name), Sample, name)):
        if not np.isfinite(sample.ego_translation).all():
            raise DocumentError(
                f"{name}: sample {token}: ego_translation: got {list(sample.ego_translation)}, expected three "
                "finite numbers"
            )
        tokens.append(token)
        ego.append(sample.ego_translation)
        parts.append(_columns(row, sample.boxes, f"{name}: sample {token}"))
    if not tokens:
        raise DocumentError(f"{name}: got no sample, expected at least one")
    return GroundTruth(
        tokens=tuple(tokens),
        ego_translation=np.array(ego),
        boxes=join([boxes for boxes, _ in parts]),
        racks=_join_racks([racks for _, racks in parts]),
    )


def _columns(sample: int, boxes: list[Box], where: str) -> tuple[BoxColumns, Racks]:
    labels = []
    for i, box in enumerate(boxes):
        label = _RACK if box.detection_name == BICYCLE_RACK else LABELS.get(box.detection_name)
        if label is None:
            raise DocumentError(
                f"{where}: box {i}: detection_name: got {box.detection_name!r}, expected one of "
                f"{', '.join(LABELS)}, {BICYCLE_RACK}"
            )
        if box.attribute_name not in ATTRIBUTE_INDEX:
            raise DocumentError(
                f"{where}: box {i}: attribute_name: got {box.attribute_name!r}, expected one of "
                f"{', '.join(filter(None, ATTRIBUTE_INDEX))} or nothing"
            )
        if box.num_pts < -1:
            raise DocumentError(
                f"{where}: box {i}: num_pts: got {box.num_pts}, expected a count, or -1 for unknown"
            )
        labels.append(label)
    columns = geometry(boxes, where)
    attribute = [ATTRIBUTE_INDEX[box.attribute_name] for box in boxes]
    return _split_racks(
        np.full(len(boxes), sample), np.array(labels, np.int64), columns, attribute, [box.num_pts for box in boxes]
    )


def _split_racks(
    sample: np.ndarray,
    label: np.ndarray,
    columns: dict[str, np.ndarray],
    attribute: Sequence[int] | np.ndarray,
    num_points: Sequence[int] | np.ndarray,
) -> tuple[BoxColumns, Racks]:
    """Boxes of the ten classes, and racks."""
    boxes = BoxColumns(
        sample=sample.astype(np.int32),
        label=label.astype(np.int8),
        translation=columns["translation"],
        size=columns["size"],
        yaw=heading_yaw(columns["rotation"]),
        velocity=columns["velocity"],
        attribute=np.array(attribute, np.int8),
        score=np.full(len(label), -1.0),
        num_points=np.array(num_points, np.int32),
    )
    rack = label == _RACK
    return boxes.take(~rack), Racks(
        sample=sample[rack].astype(np.int32),
        translation=columns["translation"][rack],
        size=columns["size"][rack],
        axes=rotation_axes(columns["rotation"][rack]),
    )


def _join_racks(parts: list[Racks]) -> Racks:
    parts = [no_racks(), *parts]
    return Racks(
        sample=np.concatenate([part.sample for part in parts]),
        translation=np.concatenate([part.translation for part in parts]),
        size=np.concatenate([part.size for part in parts]),
        axes=np.concatenate([part.axes for part in parts]),
    )


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
            raise DocumentError(
                f"{data.tables / 'attribute.json'}: name: got {name!r}, expected a known attribute"
            )
    attribute = np.array([ATTRIBUTE_INDEX.get(str(name), -1) for name in index.attribute_name] + [-1])
    boxes, racks = _split_racks(
        sample,
        wanted[index.box_category[rows]],
        {
            "translation": index.box_translation[rows],
            "size": index.box_size[rows],
            "rotation": index.box_rotation[rows],
            "velocity": index.box_velocity[rows, :2],
        },
        attribute[index.box_attribute[rows]],
        index.box_lidar_points[rows] + index.box_radar_points[rows],
    )
    ego = np.array([data.ego_translation(token) for token in tokens]).reshape(-1, 3)
    return GroundTruth(tuple(tokens), ego, boxes, racks)
