"""Can it learn? Train from random weights on one annotated frame, then detect on it.

    python -m experiments.studies.overfit_keyframe --data FOLDER  # the real keyframe of scene-0061
    python -m experiments.studies.overfit_keyframe --source synthetic  # one simulated frame, no data needed

The data folder holds ``nuscenes_scene0061/`` (a ``.pcd.bin`` and ``boxes.json``); the environment's
``FCOS_LIDAR_REAL_DATA`` names it too. Detection uses the running batch-norm statistics; there is no
augmentation. A box counts when it owns at least five cells of the single-sweep image; it is hit, one to one,
by a detection of score >= 0.3 of its class within 0.5 m in the plane and 10 degrees in yaw (modulo pi for
barriers, ignored for cones).

Cost: about five minutes a seed on two CPU cores. Expected: at least 26 of 27 boxes on the real frame, at most
5 % of the detections far from every box of their class, a mean centre error of a few centimetres.
"""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.runs import detections, trained
from experiments.script import real_data, run_script, save
from fcos_lidar_jax.assignment import owners
from fcos_lidar_jax.classes import NUSCENES_CLASSES as CLASSES
from fcos_lidar_jax.data.frame import Frame, GivenFrames, without_close
from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.evaluation.matching import candidate_pairs, match_frame
from fcos_lidar_jax.evaluation.metrics import NUSCENES_METRIC
from fcos_lidar_jax.inference.records import confident
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training.metrics_log import read_metrics
from fcos_lidar_jax.visualization.bev import draw_bev

MIN_CELLS = 5
MIN_SCORE = 0.3
MAX_DISTANCE_M = 0.5
MAX_HEADING_RAD = np.radians(10)

CONFIG = dataclasses.replace(
    QUICKSTART,
    name="overfit_keyframe",
    sensor=SENSOR.name,
    max_points=40_960,
    max_boxes=96,
    copy_paste=None,
    class_balanced=False,
    augment=None,
    model=dataclasses.replace(
        QUICKSTART.model,
        row_upscale=1,
        stem=dataclasses.replace(QUICKSTART.model.stem, dilations=(1, 3, 6)),
        backbone_blocks=(4, 4, 1, 1),
        head_convs=4,
    ),
    # At the default 0.25 a nearly square object can settle a quarter turn off with its sides exchanged: there the
    # IoU is perfect and only the L1 loss objects.
    loss=dataclasses.replace(QUICKSTART.loss, l1_weight=1.0),
    optimizer=dataclasses.replace(QUICKSTART.optimizer, batch_size=1),
)
"""The paper's depth at the quickstart's widths, on the full-size image of one sweep, rows not doubled."""


@dataclasses.dataclass(frozen=True)
class Args:
    """What to train on, and how long."""

    source: Literal["real", "synthetic"] = "real"
    """The real keyframe, or a simulated frame of the same sensor."""
    data: Path | None = None
    """Folder with nuscenes_scene0061/; default: the environment's FCOS_LIDAR_REAL_DATA."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run each."""
    steps: int = 300
    """Updates a run."""
    runs: Path = Path("outputs/overfit_keyframe")
    """Folder of the runs, with a picture of each."""
    out: Path = Path("outputs/overfit_keyframe.json")
    """Where the figures go."""


def owned_cells(frame: Frame) -> np.ndarray:
    """Cells of the single-sweep image whose point each box owns."""
    image = project_points(frame.points, np.ones(len(frame.points), bool), SENSOR, num_rounds=1)
    first = np.asarray(image.features[..., 0]).reshape(-1, 9)
    owner = owners(first[:, :3], first[:, 7] > 0, frame.boxes, np.ones(len(frame.boxes), bool))
    return np.bincount(np.asarray(owner)[np.asarray(owner) >= 0], minlength=len(frame.boxes))


def run(frame: Frame, seed: int, args: Args) -> dict[str, Any]:
    """Train on the frame from one seed, detect on it, draw, and count."""
    started = time.monotonic()
    folder, frames = args.runs / f"{args.source}_{seed}", GivenFrames((frame,), SENSOR, CLASSES)
    detector = trained(folder, CONFIG, frames, steps=args.steps, seed=seed)
    (found,), _ = detections(detector, frames)
    minutes = (time.monotonic() - started) / 60

    boxes, labels, scores = confident(found, MIN_SCORE)
    cells = owned_cells(frame)
    counted = cells >= MIN_CELLS
    # All boxes may be hit, so that a detection of a small box never takes a counted one.
    match = match_frame(
        boxes,
        labels,
        scores,
        frame.boxes,
        frame.labels,
        max_distance_m=MAX_DISTANCE_M,
        max_heading_error_rad=MAX_HEADING_RAD,
        heading_period_rad=NUSCENES_METRIC.heading_period_rad,
    )
    hit = counted[match.truth]
    centres, true_centres = boxes[:, :2], frame.boxes[:, :2]
    near = candidate_pairs(labels, centres, frame.labels, true_centres, max_distance_m=MAX_DISTANCE_M).detection
    far = ~np.isin(np.arange(len(boxes)), near)
    draw_bev(
        frame.points,
        folder / "bev.png",
        detections=(boxes, labels, scores),
        truth=(frame.boxes[counted], frame.labels[counted]),
        limit_m=SENSOR.limit_xy_m,
        classes=CLASSES,
        title=f"seed {seed}: {hit.sum()} of {counted.sum()} boxes with at least {MIN_CELLS} cells",
    )
    last = read_metrics(folder)[-1]
    return {
        "seed": seed,
        "hits": int(hit.sum()),
        "boxes": int(counted.sum()),
        "detections": len(boxes),
        "far_detections": int(far.sum()),
        "far_fraction": round(float(far.mean()) if len(far) else 0.0, 4),
        "mean_centre_error_m": round(float(match.centre_error_m[hit].mean()) if hit.any() else 0.0, 4),
        "missed": [
            f"{CLASSES[frame.labels[i]]} of {cells[i]} cells"
            for i in np.flatnonzero(counted)
            if i not in match.truth
        ],
        "mean_k": round(last["mean_k"], 2),
        "final_loss": round(last["loss/total"], 4),
        "minutes": round(minutes, 2),
    }


def main(args: Args) -> None:
    """Run all seeds, print a line each, write the figures."""
    if args.source == "real":
        folder = real_data(args.data, "nuscenes_scene0061")
        if folder is None:
            raise ValueError("--data: missing, expected the folder that holds nuscenes_scene0061/")
        frame = read_keyframe(folder, SENSOR)
    else:
        frame = make_frame(0, SENSOR)
    frame = without_close(frame, SENSOR)
    counted = frame.labels[owned_cells(frame) >= MIN_CELLS]
    names, counts = np.unique(counted, return_counts=True)
    print("boxes that count:", ", ".join(f"{c} {CLASSES[n]}" for n, c in zip(names, counts, strict=True)))
    shapes = jax.eval_shape(build_detector(CONFIG, SENSOR).init, jax.random.key(0))
    print("parameters:", count_parameters(shapes["params"])["total"])
    results = []
    for seed in args.seeds:
        results.append(run(frame, seed, args))
        print(json.dumps(results[-1]), flush=True)
    save({"source": args.source, "steps": args.steps, "seeds": results}, args.out)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
