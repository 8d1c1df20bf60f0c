"""The learning ladder: the score of a changed network or loss after a short, fixed training.

    python -m experiments.studies.ladder --trials base CenterPoint
    python -m experiments.studies.ladder --trials base "local geometry" --seeds 0 1 2
    python -m experiments.studies.ladder --trials "local geometry" larger  # the sizes of compact today
    python -m experiments.studies.ladder --trials larger "larger, looked at again" "larger, joint" --seeds 0 1 2

Each trial is a change of ``compact`` with its smaller sizes before 2026-11-27, trained on a quarter of the view of
nuScenes' HDL-32E (32 x 272 pixels) with one sweep and one round: 4,000 frames of varied simulated streets, 3,000
steps of one frame, one one-cycle schedule. The score is nuScenes' mAP on 200 unseen frames, and on 60 of them
after each quarter of the training. A second look (``refinement``) is trained in the same step ("joint"), or
afterwards on the same frames ("looked at again"), with the first trial's weights frozen and boxes that were found
once: by 3,000 updates of four frames, or, "for longer" and after "local geometry", by 24,000 of one of 2,000
frames. The seconds per step of the latter are its whole time without the detector's training, divided by the
steps; after an interruption, they lack the time before. Only "neighbours" and "local geometry, looked at again"
compare each box with its neighbours, as ``compact`` does.

The same command resumes a trial, except for the updates of a second look afterwards. Trials that are already in
the file of ``--out`` are not repeated: with ``--out experiments/results/ladder.json`` it prints the table of the
committed trials. ``experiments/LOG.md`` has an entry per question. Cost: half an hour of one core per trial, and
some minutes once for the frames.
"""

import dataclasses
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

from experiments.cached import CachedFrames
from experiments.changes import AHEAD, BONNET_M, LARGER, LONE_LOOK, QUARTER_LOOK, SLIM, Change, change
from experiments.hardware import hardware
from experiments.runs import benchmark, detections, trained
from experiments.script import Options, markdown_table, run_script, save
from experiments.second_look import USES, look_again, look_config
from experiments.statistics import gain
from experiments.studies.centerpoint import PEER
from fcos_lidar_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading, RefinementConfig
from fcos_lidar_jax.data.frame import SelectedFrames
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.models import count_parameters
from fcos_lidar_jax.presets import COMPACT
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, sector
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, SimulatedFrames
from fcos_lidar_jax.simulation.streets import CITY
from fcos_lidar_jax.training import Schedule
from fcos_lidar_jax.training.metrics_log import read_metrics

SENSOR = sector(NUSCENES_HDL32E, math.pi / 2, 272)
TRAIN_FRAMES, TEST_FRAMES, CURVE_FRAMES, STEPS = 4000, 200, 60, 3000
DISTANCES_M = ("0.5", "1.0", "2.0", "4.0")

BASE: Change = change(name="ladder", max_points=12_288, **AHEAD, projection__num_rounds=1)
_SMALL = "local geometry, joint, neighbours"


@dataclasses.dataclass(frozen=True)
class Afterwards:
    """A second look that is trained on the frozen weights of another trial."""

    first: str  # The trial whose weights it gets.
    look: RefinementConfig
    samples: int | None = None  # Augmented frames in which boxes are found; default: as many as the steps.
    updates: int = 3000
    batch_size: int = 4  # Frames per update.

    def change(self) -> Change:
        """Create the change of the configuration."""
        return lambda config: look_config(TRIALS[self.first](config), self.look, batch_size=self.batch_size)


_LONGER = 2000, USES * 2000, 1
AFTERWARDS = {
    "larger, looked at again": Afterwards("larger", LONE_LOOK),
    "CenterPoint, looked at again": Afterwards("CenterPoint", LONE_LOOK),
    f"{_SMALL}, looked at again": Afterwards(_SMALL, QUARTER_LOOK),
    f"{_SMALL}, looked at again without them": Afterwards(_SMALL, LONE_LOOK),
    f"{_SMALL}, looked at again for longer": Afterwards(_SMALL, QUARTER_LOOK, *_LONGER),
    "local geometry, looked at again": Afterwards("local geometry", QUARTER_LOOK, *_LONGER),
}
TRIALS: dict[str, Change] = {
    "base": change(model__local_geometry=False),
    "CenterPoint": PEER.change,
    "local geometry": change(),
    "larger": change(**LARGER),
    "larger, without local geometry": change(**LARGER, model__local_geometry=False),
    "local geometry, joint": change(refinement=LONE_LOOK),
    _SMALL: change(refinement=QUARTER_LOOK),
    "larger, joint": change(**LARGER, refinement=LONE_LOOK),
    "larger, joint, neighbours": change(**LARGER, refinement=QUARTER_LOOK),
}
TRIALS |= {name: how.change() for name, how in AFTERWARDS.items()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args(Options):
    """Options of the trials."""

    trials: tuple[str, ...] = ("base",)  # Names of trials.
    seeds: tuple[int, ...] = (0,)  # Seeds of weights, order and augmentation.
    steps: int = STEPS  # Updates per trial.
    work: Path = Path("outputs/ladder")  # Folder of frames and runs.


def frames(work: Path, split: str) -> CachedFrames:
    """Open the frames of a split, which are simulated once."""
    number, first = {"train": (TRAIN_FRAMES, 0), "test": (TEST_FRAMES, UNSEEN_SEED)}[split]
    reading, reach_m = CloudReading(1, "all", BONNET_M), NUSCENES_HDL32E.limit_xy_m
    made = SimulatedFrames(SENSOR, number, first, 60, reach_m, 1, reading, streets=CITY)
    return CachedFrames(made, work / f"frames_{split}_{number}")


def run_folder(name: str, seed: int, args: Args) -> Path:
    """Folder of the training of a trial."""
    return args.work / f"{name.replace(' ', '_').replace(',', '')}_{args.steps}_{seed}"


def trial(name: str, seed: int, args: Args) -> dict[str, Any]:
    """Train a trial and score it."""
    config = TRIALS[name](BASE(SLIM(COMPACT)))
    seen, tests = (frames(args.work, split) for split in ("train", "test"))
    curve_frames = SelectedFrames(tests, tuple(range(CURVE_FRAMES)))
    folder = run_folder(name, seed, args)
    if name in AFTERWARDS:
        how, began = AFTERWARDS[name], time.monotonic()
        first = run_folder(how.first, seed, args)
        if (step := load_checkpoint(first).step) != args.steps:
            raise ValueError(f"{first}: got {step} steps, expected {args.steps}: train {how.first!r} first")
        weights = load_trained(first)
        numbers = {"samples": how.samples or args.steps, "updates": how.updates, "seed": seed}
        detector = look_again(weights, config, seen, **numbers, folder=args.work / f"boxes_{folder.name}")
        seconds, records = [(time.monotonic() - began) / args.steps], []
        save_checkpoint(folder, Checkpoint(config, detector.sensor, detector.variables, args.steps))
    else:
        schedule = Schedule(-(-args.steps // 10), -(-args.steps // 4), 1)
        options: dict[str, Any] = {"steps": args.steps, "seed": seed, "tests": curve_frames, "schedule": schedule}
        detector, records = trained(folder, config, seen, **options), read_metrics(folder)
        seconds = [r["seconds"] for r in records if "seconds" in r]
    summary = benchmark(*detections(detector, tests)).summary
    return {
        "trial": name,
        "steps": args.steps,
        "seed": seed,
        "mAP": round(summary["mean_ap"], 4),
        "curve": [round(r["test/mAP"], 4) for r in records if "test/mAP" in r],
        "AP": {k: round(v, 3) for k, v in summary["mean_dist_aps"].items() if v > 0.001},
        "by_distance": {
            d: round(statistics.mean(aps[d] for aps in summary["label_aps"].values()), 4) for d in DISTANCES_M
        },
        "step_s": round(statistics.median(seconds), 3),
        "parameters": count_parameters(detector.variables["params"])["total"],
        "git": hardware()["git"],
    }


def measure(args: Args) -> None:
    """Train and score what the file does not have yet, save after each trial, print the table."""
    if unknown := [name for name in args.trials if name not in TRIALS]:
        raise ValueError(f"--trials: got {unknown[0]!r}, expected some of {', '.join(TRIALS)}")
    out = args.out or Path("outputs/ladder.json")
    rows: list[dict[str, Any]] = read_json(out, dict[str, Any])["rows"] if out.exists() else []
    for seed in args.seeds:
        for name in args.trials:
            if not any((r["trial"], r["steps"], r["seed"]) == (name, args.steps, seed) for r in rows):
                rows.append(trial(name, seed, args))
                save({"rows": rows}, out, json.dumps(rows[-1]))
    print(table(rows))
    print("\n" + details(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: mean score per trial and length, and differences from base and CenterPoint with the same seeds.

    >>> rows = [{"trial": n, "steps": 9, "seed": s, "mAP": m + 0.01 * s, "step_s": 0.3, "parameters": 7}
    ...         for n, m in (("base", 0.1), ("wide", 0.2)) for s in (0, 1)]
    >>> print(table(rows).splitlines()[-1])
    | wide | 9 | 0.2000, 0.2100 | 0.2050 | +0.1000 [+0.0696, +0.1304] | 1.95 |  | 0.30 | 7 |
    """
    header = ["trial", "steps", "mAP by seed", "mean", "minus base, 95 %", "times base", "minus CenterPoint, 95 %"]
    lines = []
    scores: dict[tuple[int, str], dict[int, float]] = {}
    for row in rows:
        scores.setdefault((row["steps"], row["trial"]), {})[row["seed"]] = row["mAP"]
    for (steps, name), own in sorted(scores.items()):
        all_of = [r for r in rows if (r["steps"], r["trial"]) == (steps, name)]
        step_s = min(r["step_s"] for r in all_of)  # of the seed that was least disturbed
        base, peer = (scores.get((steps, other), {}) if name != other else {} for other in ("base", "CenterPoint"))
        seeds, ratio = own.keys() & base.keys(), ""
        if seeds:
            ratio = f"{sum(own[s] for s in seeds) / max(sum(base[s] for s in seeds), 1e-9):.2f}"
        each, mean = ", ".join(f"{own[s]:.4f}" for s in sorted(own)), statistics.mean(own.values())
        cells = [name, f"{steps:,}", each, f"{mean:.4f}", _difference(own, base), ratio, _difference(own, peer)]
        lines.append([*cells, f"{step_s:.2f}", f"{all_of[0]['parameters']:,}"])
    return "\n".join(markdown_table([*header, "s per step", "parameters"], lines))


def _difference(own: dict[int, float], other: dict[int, float]) -> str:
    """Difference of the means and its interval; empty for fewer than two seeds of each."""
    bounds = gain([*own.values()], [*other.values()])
    return "{:+.4f} [{:+.4f}, {:+.4f}]".format(*bounds) if bounds else ""


def details(rows: list[dict[str, Any]]) -> str:
    """Markdown: AP by class and by distance, as means over the seeds that record them.

    >>> row = {"trial": "wide", "steps": 9, "seed": 0, "AP": {"car": 0.5}}
    >>> rows = [row | {"by_distance": dict.fromkeys(DISTANCES_M, 0.1)}]
    >>> print(details(rows).splitlines()[-1])
    | wide | 9 | 0.100 / 0.100 / 0.100 / 0.100 | 0.500 |
    """
    rows = [row for row in rows if "by_distance" in row]
    classes = [c for c in NUSCENES_CLASSES if any(c in row["AP"] for row in rows)]
    header = ["trial", "steps", "AP at 0.5 / 1 / 2 / 4 m", *(name.replace("_", " ") for name in classes)]
    lines = []
    for steps, name in sorted({(row["steps"], row["trial"]) for row in rows}):
        own = [row for row in rows if (row["steps"], row["trial"]) == (steps, name)]
        at = " / ".join(f"{statistics.mean(row['by_distance'][d] for row in own):.3f}" for d in DISTANCES_M)
        aps = (statistics.mean(row["AP"].get(c, 0.0) for row in own) for c in classes)
        lines.append([name, f"{steps:,}", at, *(f"{ap:.3f}" for ap in aps)])
    return "\n".join(markdown_table(header, lines))


if __name__ == "__main__":
    run_script(measure, Args, __doc__)
