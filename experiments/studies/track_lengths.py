"""How long are the tracks of ``stream --track``, and from which score on do they follow objects?

    fcos-lidar synthesize --out drives --scenes 3 --keyframes 40 --seed 1 --no-rolling-shutter
    fcos-lidar prepare --data-root drives
    for n in 1 2 3; do fcos-lidar stream --data-root drives --scene scene-000$n --keyframes --track \
      --checkpoint hdl32e --out $n.jsonl; done
    python -m experiments.studies.track_lengths --tables drives/v1.0-synthetic --lines 1.jsonl 2.jsonl 3.jsonl

Tracks the boxes that reach a score again, as ``--min-score`` does. A box finds the nearest object of its class
that no better box has found, at most 2 m away, among the objects with points. An object switches where the last
box that found it has another identity. Without ``--keyframes``, objects are known at keyframes only. Cost: two
minutes on one CPU core, or five without ``--keyframes``.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.script import Options, run_measurement
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS
from fcos_lidar_jax.inference.tracks import Tracks, to_world, track

_NEAR_M = 2.0
Objects = tuple[np.ndarray, np.ndarray, np.ndarray]  # Centres f64[m, 2] in the world, labels i32[m], which i64[m].


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """The drives and the scores."""

    tables: Path  # Folder of the drives' tables.
    lines: tuple[Path, ...]  # Output of stream, one file per drive.
    scores: tuple[float, ...] = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)  # Minimum scores.


def objects(tables: Path) -> dict[int, Objects]:
    """Objects with points, by the time of their keyframe in microseconds."""
    read = {n: json.loads((tables / f"{n}.json").read_text()) for n in ("category", "instance", "sample")}
    names = {row["token"]: row["name"] for row in read["category"]}
    classes = {row["token"]: CATEGORY_TO_CLASS[names[row["category_token"]]] for row in read["instance"]}
    numbers = {token: number for number, token in enumerate(classes)}
    times = {row["token"]: row["timestamp"] for row in read["sample"]}
    rows = dict[int, list[Any]]()
    for row in json.loads((tables / "sample_annotation.json").read_text()):
        if row["num_lidar_pts"]:
            token = row["instance_token"]
            label = NUSCENES_CLASSES.index(classes[token])
            rows.setdefault(times[row["sample_token"]], []).append((row["translation"][:2], label, numbers[token]))
    return {time: tuple(map(np.array, zip(*each, strict=True))) for time, each in rows.items()}  # type: ignore[misc]


def find_objects(centres: np.ndarray, labels: np.ndarray, scores: np.ndarray, truth: Objects) -> np.ndarray:
    """The object that each box finds, i64[m], or -1."""
    found, free = np.full(len(centres), -1), np.ones(len(truth[0]), bool)
    for box in np.argsort(-scores, kind="stable"):
        distance = np.linalg.norm(truth[0] - centres[box], axis=-1)
        distance[~free | (truth[1] != labels[box])] = np.inf
        if (nearest := int(np.argmin(distance))) >= 0 and distance[nearest] <= _NEAR_M:
            found[box], free[nearest] = truth[2][nearest], False
    return found


def measure_score(
    drives: list[list[dict[str, Any]]], truth: dict[int, Objects], min_score: float
) -> dict[str, Any]:
    """Lengths of the tracks and switches of the objects, over all drives."""
    lengths, boxes, hits, again, switches, followed = list[int](), 0, 0, 0, 0, 0
    scored = 0
    for lines in drives:
        tracks, before_us, last, every = Tracks(), None, dict[int, int](), list[int]()
        for line in lines:
            kept = [box for box in line["boxes"] if box["score"] >= min_score]
            world = to_world(
                np.array([box["box"] for box in kept]).reshape(-1, 9), np.array(line["sensor_to_world"])
            )
            labels = np.array([NUSCENES_CLASSES.index(box["label"]) for box in kept], np.int32)
            scores, time_us = np.array([box["score"] for box in kept]), line["timestamp_us"]
            dt = 0.0 if before_us is None else (time_us - before_us) / 1e6
            tracks, ids = track(tracks, world, labels, scores, dt)
            before_us, every = time_us, [*every, *ids.tolist()]
            if time_us not in truth:
                continue
            scored += len(kept)
            for thing, name in zip(find_objects(world[:, :2], labels, scores, truth[time_us]), ids, strict=True):
                if thing >= 0:
                    hits, again = hits + 1, again + (thing in last)
                    switches += last.get(thing, name) != name
                    last[thing] = name
        counts = np.bincount(every)
        lengths += counts[counts > 0].tolist()
        boxes, followed = boxes + len(every), followed + int(counts[counts >= 3].sum())
    return {
        "boxes": boxes,
        "tracks": len(lengths),
        "median_length": float(np.median(lengths)) if lengths else 0.0,
        "length_of_a_box": float(np.median(np.repeat(lengths, lengths))) if lengths else 0.0,
        "in_three_or_more": round(followed / max(boxes, 1), 3),
        "true_boxes": round(hits / max(scored, 1), 3),
        "seen_again": again,
        "switches": round(float(switches) / max(again, 1), 3),
    }


def measure(args: Args) -> dict[str, Any]:
    """Measure each score."""
    truth = objects(args.tables)
    drives = [[json.loads(line) for line in file.read_text().splitlines()] for file in args.lines]
    frames = sum(map(len, drives))
    return {"frames": frames, "scores": {str(s): measure_score(drives, truth, s) for s in args.scores}}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
