"""Can it learn? Train from random weights on one annotated frame, then detect on it.

    python experiments/overfit_keyframe.py --data FOLDER            # the real keyframe of scene-0061
    python experiments/overfit_keyframe.py --source synthetic       # one simulated frame, no data needed

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
import os
import sys
import time
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro
from hardware import hardware

from fcos_lidar_jax.assignment import owners
from fcos_lidar_jax.commands.detect import confident
from fcos_lidar_jax.config import QUICKSTART, Config
from fcos_lidar_jax.data.batching import make_batch
from fcos_lidar_jax.data.frame import Frame, without_close
from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.data.pipeline import HostBatch
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.evaluation.matching import match_frame, nearest_of_class
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.training import fit, make_optimizer, make_state, make_train_step
from fcos_lidar_jax.training.loop import Record
from fcos_lidar_jax.types import CLASSES
from fcos_lidar_jax.visualization.bev import draw_bev
from fcos_lidar_jax.visualization.curves import draw_curves

MIN_CELLS = 5
MIN_SCORE = 0.3
MAX_DISTANCE_M = 0.5
MAX_HEADING_RAD = np.radians(10)

CONFIG = dataclasses.replace(
    QUICKSTART,
    name="overfit_keyframe",
    sensor="nuscenes_hdl32e",
    max_points=40_960,
    max_boxes=96,
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
    out: Path = Path("outputs/overfit_keyframe")
    """Where result.json and the pictures go."""


def owned_cells(frame: Frame) -> np.ndarray:
    """Cells of the single-sweep image whose point each box owns."""
    image = project_points(frame.points, np.ones(len(frame.points), bool), NUSCENES_HDL32E, num_rounds=1)
    first = np.asarray(image.features[..., 0]).reshape(-1, 9)
    owner = owners(first[:, :3], first[:, 7] > 0, frame.boxes, np.ones(len(frame.boxes), bool))
    return np.bincount(np.asarray(owner)[np.asarray(owner) >= 0], minlength=len(frame.boxes))


def run(frame: Frame, seed: int, args: Args, config: Config = CONFIG) -> dict[str, Any]:
    """Train on the frame from one seed, detect on it, draw both, and count."""
    started = time.monotonic()
    sensor = NUSCENES_HDL32E
    detector = build_detector(config, sensor)
    key = jax.random.key(seed)
    variables = detector.init(key)
    optimizer = make_optimizer(config.optimizer, args.steps)
    step = jax.jit(make_train_step(detector, config, sensor, optimizer), donate_argnums=0)
    batch = make_batch([frame], max_points=config.max_points, max_boxes=config.max_boxes)
    records: list[Record] = []
    state = fit(
        step,
        make_state(variables, optimizer, key),
        [HostBatch(batch, i, {}, ("the keyframe",)) for i in range(args.steps)],
        num_steps=args.steps,
        report=lambda _, record: records.append(record),
    )
    detect = jax.jit(make_detect(detector, config, sensor))
    found = detect({"params": state.params, "batch_stats": state.batch_stats}, batch.points[0], batch.valid[0])
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
    )
    hit = counted[match.truth]
    far = nearest_of_class(boxes, labels, frame.boxes, frame.labels) > MAX_DISTANCE_M
    title = f"seed {seed}: {hit.sum()} of {counted.sum()} boxes with at least {MIN_CELLS} cells"
    draw_bev(
        frame.points,
        args.out / f"bev_seed{seed}.png",
        detections=(boxes, labels, scores),
        truth=(frame.boxes[counted], frame.labels[counted]),
        limit_m=sensor.limit_xy_m,
        title=title,
    )
    parts = ("total", "classification", "l1", "iou", "iou_prediction")
    curves = {p: [(i + 1, float(r[f"loss/{p}"])) for i, r in enumerate(records)] for p in parts}  # type: ignore[arg-type]
    draw_curves(args.out / f"loss_seed{seed}.png", curves, x_label="step", y_label="loss", title=title, log_y=True)
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
        "mean_k": round(float(records[-1]["mean_k"]), 2),  # type: ignore[arg-type]
        "final_loss": round(float(records[-1]["loss/total"]), 4),  # type: ignore[arg-type]
        "minutes": round(minutes, 2),
    }


def main(args: Args) -> None:
    """Run all seeds, print a line each, write result.json."""
    if args.source == "real":
        folder = args.data or os.environ.get("FCOS_LIDAR_REAL_DATA")
        if not folder:
            sys.exit("error: --data: missing, expected the folder that holds nuscenes_scene0061/")
        frame = read_keyframe(Path(folder) / "nuscenes_scene0061", NUSCENES_HDL32E)
    else:
        frame = make_frame(0, NUSCENES_HDL32E)
    frame = without_close(frame, NUSCENES_HDL32E)
    args.out.mkdir(parents=True, exist_ok=True)
    counted = frame.labels[owned_cells(frame) >= MIN_CELLS]
    names, counts = np.unique(counted, return_counts=True)
    print("boxes that count:", ", ".join(f"{c} {CLASSES[n]}" for n, c in zip(names, counts, strict=True)))
    shapes = jax.eval_shape(build_detector(CONFIG, NUSCENES_HDL32E).init, jax.random.key(0))
    print("parameters:", count_parameters(shapes["params"])["total"])
    results = []
    for seed in args.seeds:
        results.append(run(frame, seed, args))
        print(json.dumps(results[-1]), flush=True)
    record = {
        "source": args.source,
        "steps": args.steps,
        **hardware(),
        "seeds": results,
    }
    write_beside(args.out / "result.json", lambda path: path.write_text(json.dumps(record, indent=1)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
