"""Overfitting: train from random weights on one annotated frame, then detect in it.

    python -m experiments.studies.overfit_keyframe --data FOLDER  # the real keyframe of scene-0061
    python -m experiments.studies.overfit_keyframe --source synthetic  # one simulated frame, no data needed
    python -m experiments.studies.overfit_keyframe --detector centerpoint --data FOLDER

The data folder contains ``nuscenes_scene0061/`` (a ``.pcd.bin`` and ``boxes.json``). Only boxes that own at least
five cells of the single-sweep image count. A box is found if a detection of its class with a score of at least 0.3
is matched one to one within 0.5 m in the plane and 10 degrees in yaw (modulo pi for barriers, ignored for cones).

Cost: five minutes per seed on two CPU cores, two for CenterPoint. Expected: at least 26 of 27 boxes on the real
frame, at most 5 % of the detections far from all boxes of their class, a mean centre error of a few centimetres.
"""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from experiments.changes import change
from experiments.real_frames import read_keyframe
from experiments.runs import detections, trained
from experiments.script import Options, real_data, run_measurement
from fcos_lidar_jax.assignment import owners
from fcos_lidar_jax.centerpoint import CenterPointConfig
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames
from fcos_lidar_jax.evaluation.matching import Pairs, candidate_pairs, greedy, heading_error
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC
from fcos_lidar_jax.evaluation.records import confident
from fcos_lidar_jax.input_pipeline.database import cut_reading
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT, QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.visualization.bev import draw_bev

MIN_CELLS, MIN_SCORE, MAX_DISTANCE_M, MAX_HEADING_RAD = 5, 0.3, 0.5, np.radians(10)

CONFIG = change(
    name="overfit_keyframe",
    sensor=SENSOR.name,
    max_points=40_960,
    max_boxes=96,
    copy_paste=None,
    class_balanced=False,
    augment=None,
    # With the default, nearly square objects can stay rotated by 90 degrees, see presets.COMPACT.
    loss__l1_weight=1.0,
    optimizer__batch_size=1,
    model__row_upscale=1,
    model__stem__dilations=(1, 3, 6),
    model__backbone_blocks=(4, 4, 1, 1),
    model__head_convs=4,
)(QUICKSTART)
"""The paper's depth with the quickstart's widths, on the full-size image of one sweep without doubled rows."""
CONFIGS = {
    "fcos": CONFIG,
    "centerpoint": CenterPointConfig.of(
        CONFIG,
        name="overfit_centerpoint",
        **{part: getattr(CENTERPOINT_COMPACT, part) for part in ("model", "pillars", "loss")},
    ),
}


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the trainings."""

    detector: Literal["fcos", "centerpoint"] = "fcos"  # FCOS-LiDAR, or CenterPoint on pillars.
    source: Literal["real", "synthetic"] = "real"  # The real keyframe or a simulated frame.
    data: Path | None = None  # Folder with nuscenes_scene0061/; default: the environment's FCOS_LIDAR_REAL_DATA.
    seeds: tuple[int, ...] = (0, 1, 2)  # Seeds, one per run.
    steps: int = 300  # Updates per run.
    runs: Path = Path("outputs/overfit_keyframe")  # Folder of the runs and their pictures.


def owned_cells(frame: Frame) -> np.ndarray:
    """Count the cells of the single-sweep image that each box owns."""
    image = project_points(frame.points, np.ones(len(frame.points), bool), SENSOR, num_rounds=1)
    first = np.asarray(image.features[..., 0]).reshape(-1, 9)
    owner = owners(first[:, :3], first[:, 7] > 0, frame.boxes, np.ones(len(frame.boxes), bool))
    return np.bincount(np.asarray(owner)[np.asarray(owner) >= 0], minlength=len(frame.boxes))


def match_frame(
    boxes: Float[np.ndarray, "d 9"],
    labels: Int[np.ndarray, "d"],
    scores: Float[np.ndarray, "d"],
    true_boxes: Float[np.ndarray, "m 9"],
    true_labels: Int[np.ndarray, "m"],
    *,
    max_distance_m: float,
    max_heading_error_rad: float = np.inf,
    heading_period_rad: Float[np.ndarray, "k"] | None = None,
) -> Pairs:
    """Match detections, by decreasing score, to the nearest free truth of their class, one to one.

    Args:
        boxes, true_boxes: ``x, y, z, l, w, h, yaw, vx, vy``.
        scores: equal scores keep their order.
        max_distance_m: exclusive upper limit of the distance of a hit in the ground plane.
        max_heading_error_rad: inclusive upper limit of the yaw error of a hit.
        heading_period_rad: period per class, see :func:`heading_error`; by default 2 pi for all classes.
    """
    order = np.argsort(-scores, kind="stable")
    boxes, labels = boxes[order].astype(np.float64), labels[order]
    true_boxes = true_boxes.astype(np.float64)
    pairs = candidate_pairs(labels, boxes[:, :2], true_labels, true_boxes[:, :2], max_distance_m=max_distance_m)
    own_labels = labels[pairs.detection]
    period = np.full(len(own_labels), 2 * np.pi) if heading_period_rad is None else heading_period_rad[own_labels]
    turn = heading_error(boxes[pairs.detection, 6], true_boxes[pairs.truth, 6], period)
    pairs = pairs.take(turn <= max_heading_error_rad)
    partner = greedy(pairs, len(boxes), len(true_boxes))
    hits = pairs.take(partner[pairs.detection] == pairs.truth)
    return dataclasses.replace(hits, detection=order[hits.detection])


def _run(frame: Frame, seed: int, args: Args) -> dict[str, Any]:
    started = time.monotonic()
    folder = args.runs / f"{args.detector}_{args.source}_{seed}"
    frames = InMemoryFrames((frame,), SENSOR, NUSCENES_CLASSES)
    detector = trained(folder, CONFIGS[args.detector], frames, steps=args.steps, seed=seed)
    (found,), _ = detections(detector, frames)
    minutes = (time.monotonic() - started) / 60
    predicted, cells = confident(found, MIN_SCORE), owned_cells(frame)
    (boxes, labels, _), counted = predicted, cells >= MIN_CELLS
    # Matched with all boxes, so that the detection of a small box is never matched with a counted one.
    limits: dict[str, Any] = {"max_distance_m": MAX_DISTANCE_M, "max_heading_error_rad": MAX_HEADING_RAD}
    limits["heading_period_rad"] = NUSCENES_METRIC.heading_period_rad
    match = match_frame(*predicted, frame.boxes, frame.labels, **limits)
    hit = counted[match.truth]
    centres, true_centres = boxes[:, :2], frame.boxes[:, :2]
    near = candidate_pairs(labels, centres, frame.labels, true_centres, max_distance_m=MAX_DISTANCE_M).detection
    far = ~np.isin(np.arange(len(boxes)), near)
    draw_bev(
        frame.points,
        folder / "bev.png",
        detections=predicted,
        truth=(frame.boxes[counted], frame.labels[counted]),
        limit_m=SENSOR.limit_xy_m,
        classes=NUSCENES_CLASSES,
        title=f"seed {seed}: {hit.sum()} of {counted.sum()} boxes with at least {MIN_CELLS} cells",
    )
    last, missed = read_metrics(folder)[-1], np.setdiff1d(np.flatnonzero(counted), match.truth)
    return {
        "seed": seed,
        "hits": int(hit.sum()),
        "boxes": int(counted.sum()),
        "detections": len(boxes),
        "far_detections": int(far.sum()),
        "far_fraction": round(float(far.mean()) if len(far) else 0.0, 4),
        "mean_centre_error_m": round(float(match.distance_m[hit].mean()) if hit.any() else 0.0, 4),
        "missed": [f"{NUSCENES_CLASSES[frame.labels[i]]} of {cells[i]} cells" for i in missed],
        **({"mean_k": round(last["mean_k"], 2)} if "mean_k" in last else {}),
        "final_loss": round(last["loss/total"], 4),
        "minutes": round(minutes, 2),
    }


def measure(args: Args) -> dict[str, Any]:
    """Run all seeds and print a line for each."""
    real = args.source == "real"
    how: dict[str, Any] = {"sensor": SENSOR, "reading": cut_reading(1)}
    frame = read_keyframe(real_data(args.data, "nuscenes_scene0061"), **how) if real else make_frame(0, **how)
    results = []
    for seed in args.seeds:
        results.append(_run(frame, seed, args))
        print(json.dumps(results[-1]), flush=True)
    return {"detector": args.detector, "source": args.source, "steps": args.steps, "seeds": results}


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
