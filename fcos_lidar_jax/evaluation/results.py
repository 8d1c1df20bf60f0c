"""Read, check and write official results files of detections."""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.evaluation import json_io
from fcos_lidar_jax.evaluation.boxes import (
    ATTRIBUTE_INDEX,
    CLASS_ATTRIBUTES,
    LABELS,
    NO_BOXES,
    BoxColumns,
    join,
    make_columns,
)
from fcos_lidar_jax.evaluation.metrics import MAX_BOXES
from fcos_lidar_jax.types import Detections

USE_FLAGS = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
"""Flags of ``meta`` for the inputs of the detector."""
LIDAR_META = {flag: flag == "use_lidar" for flag in USE_FLAGS}  # meta of a LiDAR-only detector
_ALLOWED = {name: {"", *attributes} for name, attributes in CLASS_ATTRIBUTES.items()}


class ResultsFile(msgspec.Struct, gc=False):
    """Contents of the file: the inputs of the detector, and boxes by sample."""

    meta: dict[str, Any]
    results: msgspec.Raw


class Box(json_io.JsonBox, gc=False):
    """One detection in the global frame."""

    sample_token: str
    detection_score: float


@dataclasses.dataclass(frozen=True)
class Results:
    """A valid results file."""

    meta: dict[str, Any]  # unchanged from the file
    boxes: BoxColumns  # boxes in the order of the file; sample is the index into the expected tokens
    warnings: tuple[str, ...]  # one line per accepted irregularity


def read_results(
    source: str | Path | dict[str, Any], tokens: tuple[str, ...], *, of: str = "the ground truth"
) -> Results:
    """Read and check detections: a file, or the result of ``json.load``, that covers exactly the samples
    ``tokens``.

    ``of`` describes the expected samples in messages.
    """
    file, name = json_io.read_source(source, ResultsFile, given="results")
    warnings = _check_meta(file.meta, name)
    row = {token: i for i, token in enumerate(tokens)}
    found, parts = list[str](), [NO_BOXES]
    irregular = {"rotation": list[str](), "order": list[str](), "attribute": list[str]()}
    for token, boxes in json_io.decode_samples(file.results, list[Box], name, field="results"):
        found.append(token)
        if boxes and token in row:
            where = f"{name}: sample {token}"
            columns, rotation = _columns(row[token], boxes, where=where, token=token)
            parts.append(columns)
            norm, (w, x, y, z) = np.linalg.norm(rotation, axis=1), rotation.T
            irregular["rotation"] += [
                f"{where}: box {i}: rotation: normalised, got a quaternion of norm {norm[i]:.6g}"
                for i in np.flatnonzero(np.abs(norm - 1) > 1e-3)
            ]
            irregular["order"] += [
                f"{where}: box {i}: rotation: upside down, got {rotation[i].tolist()}, expected w, x, y, z"
                for i in np.flatnonzero(x * x + y * y > w * w + z * z)
            ]
            irregular["attribute"] += [
                f"{where}: box {i}: attribute_name: counted as wrong, got {box.attribute_name!r} for a "
                f"{box.detection_name}"
                for i, box in enumerate(boxes)
                if box.attribute_name not in _ALLOWED[box.detection_name]
            ]
    json_io.expect_samples(found, tokens, name, of=of)
    for lines in filter(None, irregular.values()):
        warnings.append(lines[0] + (f", and {len(lines) - 1} more" if len(lines) > 1 else ""))
    return Results(file.meta, join(parts), tuple(warnings))


def _check_meta(meta: dict[str, Any], name: str) -> list[str]:
    absent = [flag for flag in USE_FLAGS if not isinstance(meta.get(flag), bool)]
    needed = "expected true or false, which the benchmark's server needs"
    return [f"{name}: meta: {', '.join(absent)}: {needed}"] if absent else []


def _columns(sample: int, boxes: list[Box], *, where: str, token: str) -> tuple[BoxColumns, np.ndarray]:
    """Boxes of one sample and their quaternions."""
    if len(boxes) > MAX_BOXES:
        raise ValueError(f"{where}: box {MAX_BOXES}: got {len(boxes)} boxes, expected at most {MAX_BOXES}")
    columns, rotation = json_io.geometry(boxes, where)
    score = np.array([box.detection_score for box in boxes])
    json_io.expect(score >= 0, boxes, "detection_score", where, "a finite number of at least 0")
    own = np.array([box.sample_token == token for box in boxes])
    json_io.expect(own, boxes, "sample_token", where, repr(token))
    label = json_io.index_of(boxes, "detection_name", LABELS, where)
    attribute = json_io.index_of(boxes, "attribute_name", ATTRIBUTE_INDEX, where)
    rows = make_columns(sample=sample, label=label, attribute=attribute, score=score, **columns)
    return rows, rotation


MOVING_MPS = 0.2  # objects above this speed get a moving attribute


def attribute_of(name: str, speed_mps: float) -> str:
    """Likeliest attribute of a detection from its speed; ``''`` for barriers and cones.

    >>> attribute_of("bus", 0.1), attribute_of("bicycle", 3.0), attribute_of("barrier", 0.0)
    ('vehicle.stopped', 'cycle.with_rider', '')
    >>> attribute_of("car", 0.2), attribute_of("car", 0.21), attribute_of("pedestrian", 0.2)
    ('vehicle.parked', 'vehicle.moving', 'pedestrian.standing')
    """
    return (*CLASS_ATTRIBUTES[name], "", "")[0 if speed_mps > MOVING_MPS else 1]


def result_entries(
    found: Detections, token: str, sensor_to_global: np.ndarray, classes: Sequence[str] = NUSCENES_CLASSES
) -> list[dict[str, Any]]:
    """Convert detections of one sample to entries of the results file, best first, at most 500.

    Args:
        found: detections in the sample's LiDAR frame.
        sensor_to_global: f64[4, 4], pose of the sensor.
        classes: class names by label, all from the benchmark.

    >>> one = np.ones(1, bool)
    >>> car = Detections(np.array([[1.0, 0, 0, 4, 2, 1, 0, 3, 0]]), np.ones(1), np.zeros(1, int), one, np.zeros(0))
    >>> entry = result_entries(car, "a", np.eye(4))[0]
    >>> entry["size"], entry["rotation"], entry["attribute_name"]
    ([2.0, 4.0, 1.0], [1.0, 0.0, 0.0, 0.0], 'vehicle.moving')
    """
    from scipy.spatial.transform import Rotation  # SciPy takes long to import

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
    """Write an official results file of a LiDAR-only detector.

    ``samples`` are the tokens of the whole split with entries as JSON, ``[]`` for samples without detections.
    """
    lines = (b"%s: %s" % (json.dumps(token).encode(), entries) for token, entries in samples)
    json_io.write_lines(path, b'{"meta": %s, "results": {' % json.dumps(LIDAR_META).encode(), lines, b"}}\n")
