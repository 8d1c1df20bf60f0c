"""Rounds, sweeps and priority in a detector that has learned.

    python -m experiments.studies.mrv_ablations  # smoke: minutes, a toy
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 1 2
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 1 2 --small  # for CPUs
    python -m experiments.studies.mrv_ablations --by-motion RUN...  # score finished runs by motion

Tables 1, 2 and 7 compare networks of the scale ``sector``, which are small and have no local geometry, after 8,000
samples: their curves end where learning begins. These rows have the local geometry and the sizes of ``compact``,
and see 16,000 samples in batches of four, with a higher learning rate. The first row has five rounds of ten sweeps
with priority. Four rows have fewer rounds, fewer sweeps or no priority, and one row has no local geometry. The
paper's figures for one round, one sweep and no priority are -2.06, -3.66 and -2.79 points of mAP. Round offsets
are the offsets between the points of each pixel's rounds: without them, the heads see the local geometry of the
first round only.

Processes with the same folders share the cells; one of them can have ``--simulators 12`` on a machine with many
cores. Cost: on one H100 with 16 cores, 8 minutes for the frames and 3.5 minutes per cell with two processes side
by side; six fit its memory. On a CPU core, several hours per cell; with ``--small``, which keeps the sizes and the
8,000 samples of the scale, one hour.

``--by-motion`` scores finished runs of the scale ``sector`` on its test frames, for all objects, for those faster
than 0.5 m/s, and for the others. It takes some minutes of one CPU core per run.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from experiments.changes import Change, change
from experiments.paper_tables.scales import quarter
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.runs import benchmark, detections
from experiments.script import run_script, save
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.presets import COMPACT
from fcos_lidar_jax.types import Detections

_MOVING_MPS = 0.5
_NEAR_M = 2.0

_SECTOR = change(
    model__stem__out_channels=COMPACT.model.stem.out_channels,
    **{
        f"model__{name}": getattr(COMPACT.model, name)
        for name in ("backbone_blocks", "backbone_widths", "fpn_channels", "head_channels")
    },
    optimizer__epochs=4,
    optimizer__batch_size=4,
    optimizer__peak_learning_rate=4e-3,
    optimizer__ema_decay=0.992,  # The average over as many samples as with one sample per step and 0.998.
)


@dataclasses.dataclass(frozen=True)
class AblationArgs(Args):
    """Options of the table."""

    epochs: int | None = None  # Passes over the training frames; default: 4, or 2 for smoke and with --small.
    small: bool = False  # Keep the sizes, batches and epochs of the scale.
    by_motion: tuple[Path, ...] = ()  # Finished runs to score by the motion of objects, instead of the table.


def make_table(epochs: int | None = None, *, small: bool = False) -> Table:
    """Create the table; its files are named after the options."""

    def trained(part: Change) -> Change:
        length = {} if epochs is None else {"optimizer__epochs": epochs}

        def apply(config: Config) -> Config:
            grown = config.name == "sector" and not small
            return change(**length)(part(_SECTOR(config) if grown else config))

        return apply

    def ours(**fields: Any) -> Change:
        return trained(change(model__local_geometry=True, **fields))

    name, title = "mrv_ablations", "Rounds, sweeps and priority, with local geometry"
    if small:
        name, title = f"{name}_small", f"{title}, small networks"
    if epochs is not None:
        name, title = f"{name}_{epochs}_epochs", f"{title}, {epochs} epochs"
    rows = (
        Row("five rounds of ten sweeps", ours()),
        Row("one round of ten sweeps", ours(projection__num_rounds=1)),
        Row("without priority", ours(projection__prioritize_current=False)),
        Row("five rounds of one sweep", ours(num_sweeps=1)),
        Row("one round of one sweep", ours(num_sweeps=1, projection__num_rounds=1)),
        Row("five rounds of ten sweeps with round offsets", ours(model__round_offsets=True)),
        Row("without local geometry", trained(change())),
    )
    return Table(name, title, rows, reference=rows[0].label)


TABLE = make_table()
SMALL = make_table(small=True)


def scores_by_motion(detector: TrainedDetector, frames: FrameSet) -> dict[str, Any]:
    """Score a detector for all, moving and standing objects: mAP of the classes that are there, AP, cars."""
    found, tests = detections(detector, frames)
    record = {"all objects": _scores(found, tests)}
    for motion, moving in (("moving", True), ("standing", False)):
        parts = [by_motion(d, frame, moving) for d, frame in zip(found, tests, strict=True)]
        record[f"{motion} objects"] = _scores([d for d, _ in parts], [frame for _, frame in parts])
    return record


def _scores(found: list[Detections], frames: list[Frame]) -> dict[str, Any]:
    summary = benchmark(found, frames).summary
    aps = {name: round(ap, 3) for name, ap in summary["mean_dist_aps"].items()}
    labels = np.unique(np.concatenate([frame.labels for frame in frames]))
    mean = np.mean([summary["mean_dist_aps"][NUSCENES_CLASSES[label]] for label in labels])
    error = round(summary["label_tp_errors"]["car"]["vel_err"], 3)
    return {"mAP": round(float(mean), 4), "AP": aps, "velocity error of cars": error}


def by_motion(found: Detections, frame: Frame, moving: bool) -> tuple[Detections, Frame]:
    """Select the moving or the standing objects.

    A detection within 2 m of an object of its class belongs to the nearest one, and is dropped if that one is not
    selected. All other detections stay in both selections, so both APs include them as false positives.
    """
    own = (np.hypot(frame.boxes[:, 7], frame.boxes[:, 8]) > _MOVING_MPS) == moving
    boxes, labels = np.asarray(found.boxes), np.asarray(found.labels)
    distance = np.linalg.norm(boxes[:, None, :2] - frame.boxes[:, :2], axis=2)
    distance = np.where(labels[:, None] == frame.labels, distance, np.inf)
    nearest = distance.min(axis=1, where=own, initial=np.inf), distance.min(axis=1, where=~own, initial=np.inf)
    of_others = (nearest[1] < _NEAR_M) & (nearest[1] < nearest[0])
    kept = {name: getattr(frame, name)[own] for name in ("boxes", "labels", "num_points")}
    selected = dataclasses.replace(found, valid=np.asarray(found.valid) & ~of_others)
    return selected, dataclasses.replace(frame, **kept)


def main(args: AblationArgs) -> None:
    """Train and print the table, or score runs by motion."""
    if args.by_motion:
        scale, runs = quarter(args.runs / "frames"), {path.name: load_trained(path) for path in args.by_motion}
        tests = {name: scale.frames("test", run.config.num_sweeps) for name, run in runs.items()}
        record = {name: scores_by_motion(run, tests[name]) for name, run in runs.items()}
        save(record, args.out / "by_motion.json")
        return
    if args.scale == "nuscenes":
        raise ValueError("--scale: got nuscenes, expected smoke or sector")
    if args.epochs is not None and args.epochs < 1:
        raise ValueError(f"--epochs: got {args.epochs}, expected at least 1")
    run_table(make_table(args.epochs, small=args.small), args)


if __name__ == "__main__":
    run_script(main, AblationArgs, __doc__)
