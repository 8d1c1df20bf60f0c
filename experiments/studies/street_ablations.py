"""What does each randomisation of the streets do for real sweeps?

    python -m experiments.studies.street_ablations --data FOLDER

FOLDER holds the real keyframes (``nuscenes_scene0523/``, ``nuscenes_scene0103/``, ``nuscenes_scene0061/``).
Every cell trains the quickstart's network on the full 32x1086 image for the same number of steps, each on a fresh
frame of other streets: plain ones, varied ones, varied ones without one randomisation, plain ones with one. Each
is evaluated on unseen varied streets and on the real keyframes, by class and by range. The even keyframes of
scene-0523 are there to choose by, the odd ones to report. ``--seeds 0 1 2`` shows how far trainings differ by
chance.

The same command resumes a stopped study and keeps the cells that are done; ``--only NAME ...`` does some of them.
The table of all that are done is written beside the figures, as Markdown. Cost: 20 minutes a cell of 1200 steps on
two CPU cores.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.changes import change
from experiments.real_frames import real_frames, scores_by_range
from experiments.runs import detections, trained
from experiments.script import run_script, save
from experiments.studies.real_scene import CONFIG
from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.files import atomic_write
from fcos_lidar_jax.sensors import NUSCENES_HDL32E
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, city_frames
from fcos_lidar_jax.simulation.streets import CITY, PLAIN, Streets

GROUPS: dict[str, tuple[str, ...]] = {
    "pitch": ("pitch_rad", "mount_m"),
    "noise": ("range_noise_m", "ring_range_m", "ring_elevation_rad"),
    "intensity": ("speckle", "ring_gain", "shading"),
    "missing returns": ("faint", "weather"),
    "rolling shutter": ("rolling_shutter",),
    "ego outline": ("ego_outline", "ego_edges"),
    "ground": ("slopes", "relief_m", "roughness_m", "crown_m"),
    "clutter": ("clutter",),
    "facades": ("facades",),
    "settings": ("setting",),
    "city classes": ("city_classes", "class_mix"),
    "distances": ("spread",),
    "groups": ("groups",),
    "shapes": ("shape", "sizes", "round_cars"),
}
"""Randomisation -> fields of the streets. Frames without slopes have a level mount: "ground" has the pitch too."""


def mixed(base: Streets, other: Streets, group: str) -> Streets:
    """Streets with one group of fields from others.

    >>> mixed(CITY, PLAIN, "clutter").clutter
    0.0
    """
    name = f"{base.name}, {group} of {other.name}"
    return dataclasses.replace(base, name=name, **{field: getattr(other, field) for field in GROUPS[group]})


COLUMNS = {
    "unseen streets, mAP": ("unseen streets", None),
    "scene-0523 even, mAP": ("scene-0523, even", None),
    "car": ("scene-0523, even", "car"),
    "scene-0523 odd, mAP": ("scene-0523, odd", None),
    "car ": ("scene-0523, odd", "car"),
    "scene-0103, car": ("scene-0103", "car"),
    "pedestrian": ("scene-0103", "pedestrian"),
}
"""Column of the table -> frames, and the class, None for the mAP."""


def as_markdown(record: Mapping[str, Any]) -> str:
    """A row for each kind of streets, in the order of :data:`CELLS`: scores in percent, means over the seeds."""
    lines = [
        "| streets | seeds | " + " | ".join(map(str.strip, COLUMNS)) + " |",
        "|---" * (len(COLUMNS) + 2) + "|",
    ]
    for name in CELLS:
        cells = [cell["scores"] for label, cell in record.items() if label.startswith(f"{name}, ")]
        if cells:
            texts = [f"{100 * _mean(cells, test, label):.1f}" for test, label in COLUMNS.values()]
            lines.append(" | ".join([f"| {name}", str(len(cells)), *texts]) + " |")
    return "\n".join(lines) + "\n"


def _mean(cells: Sequence[Any], test: str, label: str | None) -> float:
    scores = [cell[test]["all"] for cell in cells]
    return sum(s["mAP"] if label is None else s["AP"][label] for s in scores) / len(scores)


CELLS = (
    {"plain": PLAIN, "city": CITY}
    | {f"city without {group}": mixed(CITY, PLAIN, group) for group in GROUPS}
    | {f"plain with {group}": mixed(PLAIN, CITY, group) for group in GROUPS}
)


@dataclasses.dataclass(frozen=True)
class Args:
    """What to train, and how long."""

    data: Path | None = None  # Folder with the real keyframes; default: the environment's FCOS_LIDAR_REAL_DATA.
    steps: int = 1200  # Updates of every cell, on a frame each.
    test_frames: int = 60  # Unseen varied streets to evaluate on.
    only: tuple[str, ...] = ()  # Of the cells, by name; default: all.
    seeds: tuple[int, ...] = (0,)  # Of the trainings; each has other streets.
    runs: Path = Path("outputs/street_ablations")  # Folder of the runs.
    out: Path = Path("outputs/street_ablations.json")  # Where the figures go.


def main(args: Args) -> None:
    """Train and evaluate the cells that are missing, one after the other."""
    if unknown := set(args.only) - set(CELLS):
        raise ValueError(f"--only: got {sorted(unknown)[0]!r}, expected some of {', '.join(map(repr, CELLS))}")
    config = change(augment=AugmentConfig())(CONFIG)
    tests = {"unseen streets": city_frames(NUSCENES_HDL32E, args.test_frames, UNSEEN_SEED)}
    tests |= real_frames(args.data, config.reading)
    record: dict[str, Any] = json.loads(args.out.read_text(encoding="utf-8")) if args.out.exists() else {}
    for seed in args.seeds:
        for name in args.only or CELLS:
            cell = f"{name}, {args.steps} steps, seed {seed}"
            streets = dataclasses.asdict(CELLS[name])
            if record.get(cell, {}).get("streets") == streets:
                continue
            frames = city_frames(NUSCENES_HDL32E, args.steps, seed * args.steps, streets=CELLS[name])
            folder = args.runs / cell.replace(", ", "_").replace(" ", "_")
            detector = trained(folder, config, frames, steps=args.steps, seed=seed)
            scores = {test: scores_by_range(*detections(detector, frames)) for test, frames in tests.items()}
            record[cell] = {"streets": streets, "scores": scores}
            every = {test: by_span["all"] for test, by_span in scores.items()}
            short = {test: {"mAP": s["mAP"], "car": s["AP"]["car"]} for test, s in every.items()}
            save(record, args.out, f"{cell}: {json.dumps(short)}")
    text = as_markdown(record)
    atomic_write(args.out.with_suffix(".md"), lambda file: file.write_text(text, encoding="utf-8"))
    print(text)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
