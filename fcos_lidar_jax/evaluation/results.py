"""The official results file of detections: read and checked to the last field, and written."""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.evaluation.boxes import (
    ATTRIBUTE_INDEX,
    CLASS_ATTRIBUTES,
    LABELS,
    NO_BOXES,
    BoxColumns,
    heading_yaw,
    join,
    make_columns,
)
from fcos_lidar_jax.evaluation.json_io import (
    decode_json,
    decode_samples,
    encode_json,
    expect_samples,
    read_json,
    split_samples,
)
from fcos_lidar_jax.evaluation.metrics import MAX_BOXES
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.types import Detections

USE_FLAGS = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
"""What ``meta`` tells of the input that was used."""
LIDAR_META = {flag: flag == "use_lidar" for flag in USE_FLAGS}
"""``meta`` of a detector that sees the LiDAR alone."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Velocity = tuple[float | None, float | None] | None


class ResultsFile(msgspec.Struct, gc=False):
    """The file: what was used, and boxes by sample."""

    meta: dict[str, Any]
    results: msgspec.Raw


class Box(msgspec.Struct, gc=False):
    """One detection in the global frame."""

    sample_token: str
    translation: Vector
    size: Vector
    rotation: Quaternion
    velocity: Velocity
    detection_name: str
    detection_score: float
    attribute_name: str


@dataclasses.dataclass(frozen=True)
class Results:
    """A results file that may be evaluated."""

    meta: dict[str, Any]
    """As in the file."""
    boxes: BoxColumns
    """In the order of the file, ``sample`` counting the wanted tokens."""
    warnings: tuple[str, ...]
    """What was accepted and should not be: a line each."""


def read_results(
    source: str | Path | dict[str, Any], tokens: tuple[str, ...], *, of: str = "the ground truth"
) -> Results:
    """Read and check detections.

    Args:
        source: the file, or what ``json.load`` gives for it.
        tokens: the samples that it must cover, no more and no less.
        of: what they are the samples of, for the messages.

    Raises:
        ValueError: naming the file, the sample, the box (from 0) and the field.
    """
    given = isinstance(source, dict)
    name = "results" if given else str(source)
    file = decode_json(encode_json(source) if given else read_json(source), ResultsFile, name)
    warnings = _check_meta(file.meta, name)
    entries = split_samples(file.results, f"{name}: results")
    row = {token: i for i, token in enumerate(tokens)}
    parts = [NO_BOXES]
    off_norm: list[tuple[str, int, float]] = []
    wanted = {token: entry for token, entry in entries.items() if token in row}
    for token, boxes in decode_samples(wanted, list[Box], name):
        if boxes:
            columns, norm = _columns(row[token], boxes, where=f"{name}: sample {token}", token=token)
            parts.append(columns)
            off_norm += [(token, int(i), float(norm[i])) for i in np.flatnonzero(np.abs(norm - 1) > 1e-3)]
    expect_samples(entries, tokens, name, of=of)
    if off_norm:
        token, box, norm = off_norm[0]
        more = f"; so were {len(off_norm) - 1} more" if len(off_norm) > 1 else ""
        warnings.append(
            f"{name}: sample {token}: box {box}: rotation: normalised, got a quaternion of norm {norm:.6g}{more}"
        )
    return Results(file.meta, join(parts), tuple(warnings))


def _check_meta(meta: dict[str, Any], name: str) -> list[str]:
    for flag in USE_FLAGS:
        if flag in meta and not isinstance(meta[flag], bool):
            raise ValueError(f"{name}: meta: {flag}: got {meta[flag]!r}, expected true or false")
    absent = [flag for flag in USE_FLAGS if flag not in meta]
    return [f"{name}: meta: {', '.join(absent)}: missing; the benchmark's server wants all five"] if absent else []


def _columns(sample: int, boxes: list[Box], *, where: str, token: str) -> tuple[BoxColumns, np.ndarray]:
    """One sample's boxes and the norms of their quaternions."""
    if len(boxes) > MAX_BOXES:
        raise ValueError(f"{where}: box {MAX_BOXES}: got {len(boxes)} boxes, expected at most {MAX_BOXES}")
    columns, rotation = geometry(boxes, where)
    score = np.array([box.detection_score for box in boxes])
    expect(where, "detection_score", score, (score >= 0) & np.isfinite(score), "a finite number of at least 0")
    kinds = [_KIND_ROW.get((box.detection_name, box.attribute_name), -1) for box in boxes]
    if min(kinds) < 0 or any(box.sample_token != token for box in boxes):
        _refuse_names(boxes, where, token)
    label, attribute = _KIND_COLUMNS[:, kinds]
    rows = make_columns(sample=sample, label=label, attribute=attribute, score=score, **columns)
    return rows, np.linalg.norm(rotation, axis=1)


_KINDS = [(name, attribute) for name, allowed in CLASS_ATTRIBUTES.items() for attribute in ("", *allowed)]
_KIND_ROW = {kind: row for row, kind in enumerate(_KINDS)}
"""Class and attribute of a box, where they go together."""
_KIND_COLUMNS = np.array([[LABELS[name], ATTRIBUTE_INDEX[attribute]] for name, attribute in _KINDS], np.int16).T


def _refuse_names(boxes: list[Box], where: str, token: str) -> None:
    """Raise for the first box with a wrong name."""
    tokens, names, attributes = (
        np.array([getattr(box, field) for box in boxes])
        for field in ("sample_token", "detection_name", "attribute_name")
    )
    expect(where, "sample_token", tokens, tokens == token, repr(token))
    expect(where, "detection_name", names, np.isin(names, list(LABELS)), f"one of {', '.join(LABELS)}")
    good = np.array([(box.detection_name, box.attribute_name) in _KIND_ROW for box in boxes])
    name = str(names[np.argmin(good)])
    allowed = " or ".join(filter(None, (", ".join(CLASS_ATTRIBUTES[name]), "nothing")))
    expect(where, "attribute_name", attributes, good, f"{allowed} for a {name}")


def geometry(boxes: list[Any], where: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Translation, size, yaw and velocity of boxes as columns, and their rotations f64[n, 4], checked.

    Args:
        boxes: with these fields.
        where: file and sample, for the messages.

    Raises:
        ValueError: naming the box and the field.
    """
    unknown = (None, None)
    # One flat list: several times as fast as arrays of tuples. None becomes NaN.
    numbers = chain.from_iterable(
        [box.translation + box.size + box.rotation + (box.velocity or unknown) for box in boxes]
    )
    table = np.array(list(numbers), np.float64).reshape(-1, 12)
    translation, size, rotation, velocity = np.split(table, (3, 6, 10), axis=1)
    expect(where, "translation", translation, np.isfinite(translation).all(axis=1), "three finite numbers")
    fine = (np.isfinite(size) & (size > 0)).all(axis=1)
    expect(where, "size", size, fine, "three positive lengths")
    fine = np.isfinite(rotation).all(axis=1) & (rotation != 0).any(axis=1)
    expect(where, "rotation", rotation, fine, "a quaternion w, x, y, z that is not zero")
    columns = {"translation": translation, "size": size, "yaw": heading_yaw(rotation), "velocity": velocity}
    return columns, rotation


def expect(where: str, field: str, values: np.ndarray, good: np.ndarray | np.bool, expected: str) -> None:
    """Refuse the first box whose value is not good."""
    if not good.all():
        box = int(np.argmin(good))
        raise ValueError(f"{where}: box {box}: {field}: got {values[box].tolist()!r}, expected {expected}")


MOVING_MPS = 0.2
"""Faster objects have a moving attribute."""

_MOVING = {
    **dict.fromkeys(("car", "truck", "bus", "trailer", "construction_vehicle"), "vehicle.moving"),
    **dict.fromkeys(("motorcycle", "bicycle"), "cycle.with_rider"),
    "pedestrian": "pedestrian.moving",
}
_STILL = {
    **dict.fromkeys(("car", "truck", "trailer", "construction_vehicle"), "vehicle.parked"),
    **dict.fromkeys(("motorcycle", "bicycle"), "cycle.without_rider"),
    "bus": "vehicle.stopped",
    "pedestrian": "pedestrian.standing",
}


def attribute_of(name: str, speed_mps: float) -> str:
    """The likeliest attribute of a detection, which has none of its own; ``''`` for barriers and cones.

    >>> attribute_of("bus", 0.1), attribute_of("bicycle", 3.0), attribute_of("barrier", 0.0)
    ('vehicle.stopped', 'cycle.with_rider', '')
    """
    return (_MOVING if speed_mps > MOVING_MPS else _STILL).get(name, "")


def result_entries(
    found: Detections, token: str, sensor_to_global: np.ndarray, classes: Sequence[str] = NUSCENES_CLASSES
) -> list[dict[str, Any]]:
    """Detections of one sample as entries of the results file, best first, 500 at most.

    Args:
        found: of one sample, in its LiDAR frame.
        token: of the sample.
        sensor_to_global: f64[4, 4].
        classes: names that the labels index, of the benchmark's.

    >>> one = np.ones(1, bool)
    >>> car = Detections(np.array([[1.0, 0, 0, 4, 2, 1, 0, 3, 0]]), np.ones(1), np.zeros(1, int), one, np.zeros(0))
    >>> entry = result_entries(car, "a", np.eye(4))[0]
    >>> entry["size"], entry["rotation"], entry["attribute_name"]
    ([2.0, 4.0, 1.0], [1.0, 0.0, 0.0, 0.0], 'vehicle.moving')
    """
    valid = np.flatnonzero(np.asarray(found.valid))[:MAX_BOXES]
    boxes = np.asarray(found.boxes, np.float64)[valid]
    names = [classes[int(label)] for label in np.asarray(found.labels)[valid]]
    scores = np.asarray(found.scores, np.float64)[valid]
    turn = sensor_to_global[:3, :3]
    centres = boxes[:, :3] @ turn.T + sensor_to_global[:3, 3]
    rotations = Rotation.from_matrix(turn) * Rotation.from_rotvec(np.pad(boxes[:, 6:7], ((0, 0), (2, 0))))
    quaternions = rotations.as_quat(canonical=True, scalar_first=True).reshape(-1, 4)
    velocities = np.pad(boxes[:, 7:9], ((0, 0), (0, 1))) @ turn.T
    speeds = np.hypot(boxes[:, 7], boxes[:, 8])
    return [
        {
            "sample_token": token,
            "translation": centres[i].tolist(),
            "size": boxes[i, [4, 3, 5]].tolist(),
            "rotation": quaternions[i].tolist(),
            "velocity": velocities[i, :2].tolist(),
            "detection_name": name,
            "detection_score": float(scores[i]),
            "attribute_name": attribute_of(name, float(speeds[i])),
        }
        for i, name in enumerate(names)
    ]


def write_results(path: str | Path, samples: Iterable[tuple[str, bytes]]) -> None:
    """Write an official results file of a detector that sees the LiDAR alone.

    Args:
        path: JSON file to write.
        samples: every token of the split with its entries as JSON, ``[]`` where nothing was found.
    """

    def write(file: Path) -> None:
        with file.open("wb") as stream:
            stream.write(b'{"meta": %s, "results": {' % json.dumps(LIDAR_META).encode())
            for i, (token, entries) in enumerate(samples):
                stream.write(b"%s\n%s: %s" % (b"," if i else b"", json.dumps(token).encode(), entries))
            stream.write(b"\n}}\n")

    atomic_write(path, write)
