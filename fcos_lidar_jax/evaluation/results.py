"""The official results file of detections: read and checked to the last field."""

import dataclasses
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fcos_lidar_jax.evaluation.boxes import (
    ATTRIBUTE_INDEX,
    CLASS_ATTRIBUTES,
    LABELS,
    UNKNOWN_POINTS,
    BoxColumns,
    heading_yaw,
    join,
)
from fcos_lidar_jax.evaluation.documents import (
    DocumentError,
    as_document,
    by_sample,
    decode_document,
    decode_samples,
    expect_samples,
    read_document,
)
from fcos_lidar_jax.evaluation.metrics import MAX_BOXES

USE_FLAGS = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
"""What ``meta`` tells of the input that was used."""
LIDAR_META = {flag: flag == "use_lidar" for flag in USE_FLAGS}
"""``meta`` of a detector that sees the LiDAR alone."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Velocity = tuple[float | None, float | None] | None


class Document(msgspec.Struct, gc=False):
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
        DocumentError: naming the file, the sample, the box (from 0) and the field.
    """
    given = isinstance(source, dict)
    name = "results" if given else str(source)
    document = decode_document(as_document(source) if given else read_document(source), Document, name)
    warnings = _check_meta(document.meta, name)
    entries = by_sample(document.results, f"{name}: results")
    row = {token: i for i, token in enumerate(tokens)}
    parts: list[BoxColumns] = []
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
    return Results(document.meta, join(parts), tuple(warnings))


def _check_meta(meta: dict[str, Any], name: str) -> list[str]:
    for flag in USE_FLAGS:
        if flag in meta and not isinstance(meta[flag], bool):
            raise DocumentError(f"{name}: meta: {flag}: got {meta[flag]!r}, expected true or false")
    absent = [flag for flag in USE_FLAGS if flag not in meta]
    return [f"{name}: meta: {', '.join(absent)}: missing; the benchmark's server wants all five"] if absent else []


def _columns(sample: int, boxes: list[Box], *, where: str, token: str) -> tuple[BoxColumns, np.ndarray]:
    """One sample's boxes and the norms of their quaternions."""
    if len(boxes) > MAX_BOXES:
        raise DocumentError(f"{where}: box {MAX_BOXES}: got {len(boxes)} boxes, expected at most {MAX_BOXES}")
    columns = geometry(boxes, where)
    score = np.array([box.detection_score for box in boxes])
    expect(where, "detection_score", score, (score >= 0) & np.isfinite(score), "a finite number of at least 0")
    kinds = [_KIND_ROW.get((box.detection_name, box.attribute_name), -1) for box in boxes]
    if min(kinds) < 0 or any(box.sample_token != token for box in boxes):
        raise _name_fault(boxes, where, token)
    label, attribute = _KIND_COLUMNS[:, kinds]
    rows = BoxColumns(
        sample=np.full(len(boxes), sample, np.int32),
        label=label,
        translation=columns["translation"],
        size=columns["size"],
        yaw=heading_yaw(columns["rotation"]),
        velocity=columns["velocity"],
        attribute=attribute,
        score=score,
        num_points=np.full(len(boxes), UNKNOWN_POINTS, np.int32),
    )
    return rows, np.linalg.norm(columns["rotation"], axis=1)


_KINDS = [(name, attribute) for name, allowed in CLASS_ATTRIBUTES.items() for attribute in ("", *allowed)]
_KIND_ROW = {kind: row for row, kind in enumerate(_KINDS)}
"""Class and attribute of a box, where they go together."""
_KIND_COLUMNS = np.array([[LABELS[name], ATTRIBUTE_INDEX[attribute]] for name, attribute in _KINDS], np.int8).T


def _name_fault(boxes: list[Box], where: str, token: str) -> DocumentError:
    """What is wrong with the names of the first box that has a wrong one."""
    faulty = (
        (box.detection_name, box.attribute_name) not in _KIND_ROW or box.sample_token != token for box in boxes
    )
    i = list(faulty).index(True)
    box = boxes[i]
    allowed = CLASS_ATTRIBUTES.get(box.detection_name)
    if box.sample_token != token:
        fault = f"sample_token: got {box.sample_token!r}, expected {token!r}"
    elif allowed is None:
        fault = f"detection_name: got {box.detection_name!r}, expected one of {', '.join(LABELS)}"
    else:
        fault = (
            f"attribute_name: got {box.attribute_name!r}, expected "
            f"{', '.join((*allowed, 'nothing')).replace(', nothing', ' or nothing')} for a {box.detection_name}"
        )
    return DocumentError(f"{where}: box {i}: {fault}")


def geometry(boxes: list[Any], where: str) -> dict[str, np.ndarray]:
    """Translation, size, rotation and velocity of boxes as columns, checked.

    Args:
        boxes: with these fields.
        where: file and sample, for the messages.

    Raises:
        DocumentError: naming the box and the field.
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
    return {"translation": translation, "size": size, "rotation": rotation, "velocity": velocity}


def expect(where: str, field: str, values: np.ndarray, good: np.ndarray | np.bool, expected: str) -> None:
    """Refuse the first box whose value is not good."""
    if not good.all():
        box = int(np.argmin(good))
        raise DocumentError(f"{where}: box {box}: {field}: got {values[box].tolist()}, expected {expected}")
