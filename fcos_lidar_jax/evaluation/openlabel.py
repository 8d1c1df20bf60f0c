"""Detections as an ASAM OpenLABEL 1.0 file, which annotation tools read as pre-labels."""

import itertools
import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.evaluation.json_io import write_lines

_LIDAR, _WORLD = "lidar", "world"  # names of the coordinate systems


def write_openlabel(path: str | Path, records: Iterable[dict[str, Any]], *, annotator: str = "") -> None:
    """Write the boxes of a drive or of several clouds as cuboids, in the frame of each cloud.

    Each box is an object, or, with tracks, the boxes of one track are. An object's ``type`` is the class, and its
    cuboid is ``x, y, z, qx, qy, qz, qw, sx, sy, sz``: metres, and sx along the heading. The score is the attribute
    ``score``, and a known velocity in m/s the attribute ``velocity``. Frames have the file of their cloud and, if
    they are known, the time in seconds and the transform from the LiDAR to the world.

    Args:
        records: lines of ``fcos-lidar stream``, or entries of ``fcos-lidar detect``; iterated twice.
        annotator: name of the program and the detector that made the boxes.

    >>> import json, tempfile
    >>> file = Path(tempfile.mkdtemp()) / "labels.json"
    >>> box = {"label": "car", "score": 0.5, "box": [8, 0, 0, 4, 2, 1, 0, 3, 0]}
    >>> write_openlabel(file, [{"file": "a.npy", "boxes": [box]}])
    >>> found = json.loads(file.read_text())["openlabel"]
    >>> found["objects"]["0"]["type"], found["frames"]["0"]["objects"]["0"]["object_data"]["cuboid"][0]["val"]
    ('car', [8, 0, 0, 0.0, 0.0, 0.0, 1.0, 4, 2, 1])
    """
    objects, posed, number = dict[str, dict[str, Any]](), False, -1
    for number, record in enumerate(_identified(records)):
        posed |= record.get("sensor_to_world") is not None
        for uid, box in record["boxes"]:
            entry = {"name": f"{box['label']} {uid}", "type": box["label"], "frame_intervals": []}
            _extend(objects.setdefault(uid, entry)["frame_intervals"], number)
    systems = {_LIDAR: {"type": "sensor_cs", "parent": _WORLD if posed else "", "children": []}}
    if posed:
        systems = {_WORLD: {"type": "scene_cs", "parent": "", "children": [_LIDAR]}, **systems}
    head = {
        "metadata": {"schema_version": "1.0.0", "annotator": annotator},
        "coordinate_systems": systems,
        "streams": {_LIDAR: {"type": "lidar"}},
        "frame_intervals": [{"frame_start": 0, "frame_end": number}] if number >= 0 else [],
        "objects": objects,
    }
    before = b'{"openlabel": %s, "frames": {' % json.dumps(head)[:-1].encode()
    write_lines(path, before, _frames(records), b"}}}\n")


def _identified(records: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The records, with pairs of object and box as boxes. Boxes without a track are numbered."""
    number = itertools.count()
    for record in records:
        yield {
            **record,
            "boxes": [
                (str(box.get("track", uid)), box) for box, uid in zip(record["boxes"], number, strict=False)
            ],
        }


def _extend(intervals: list[dict[str, int]], frame: int) -> None:
    if intervals and intervals[-1]["frame_end"] == frame - 1:
        intervals[-1]["frame_end"] = frame
    else:
        intervals.append({"frame_start": frame, "frame_end": frame})


def _frames(records: Iterable[dict[str, Any]]) -> Iterator[bytes]:
    for number, record in enumerate(_identified(records)):
        properties: dict[str, Any] = {"streams": {_LIDAR: {"uri": record["file"]}}}
        if record.get("timestamp_us") is not None:
            properties["timestamp"] = record["timestamp_us"] / 1e6
        if (pose := record.get("sensor_to_world")) is not None:
            matrix = {"matrix4x4": np.ravel(pose).tolist()}
            transform = {"src": _LIDAR, "dst": _WORLD, "transform_src_to_dst": matrix}
            properties["transforms"] = {f"{_LIDAR}_to_{_WORLD}": transform}
        objects = {uid: {"object_data": {"cuboid": [_cuboid(box)]}} for uid, box in record["boxes"]}
        frame = {"frame_properties": properties, "objects": objects}
        yield b'"%d": %s' % (number, json.dumps(frame).encode())


def _cuboid(box: dict[str, Any]) -> dict[str, Any]:
    *place_and_size, yaw, vx, vy = box["box"]
    turn = [0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]
    attributes: dict[str, Any] = {"num": [{"name": "score", "val": box["score"]}]}
    if math.isfinite(vx) and math.isfinite(vy):
        attributes["vec"] = [{"name": "velocity", "val": [vx, vy]}]
    value = [*place_and_size[:3], *turn, *place_and_size[3:]]
    return {"name": "shape", "coordinate_system": _LIDAR, "val": value, "attributes": attributes}
