"""Speed and memory of the evaluation compared with the official devkit, on the same files.

    pip install --no-deps nuscenes-devkit==1.2.0
    pip install opencv-python-headless scikit-learn cachetools pyquaternion tqdm
    python -m experiments.benchmarks.evaluation_speed

Generates a data set and a results file of the size of nuScenes val (6,019 keyframes in 150 scenes, with 30
annotations and 200 predictions each), evaluates it with both in separate processes, and expects identical scores.
Compares the time from tables in memory to the summary (the devkit's ``DetectionEval`` without curves) and the time
of the whole process. Also measures the command ``fcos-lidar evaluate --results FILE``.

Cost: five minutes, 1.5 GB of disk, 3 GB of memory. Expected: 20 times as fast from the tables on, below 2 GiB.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments.script import Options, run_script, save
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS
from fcos_lidar_jax.data.nuscenes.splits import official_splits
from fcos_lidar_jax.evaluation.boxes import CLASS_ATTRIBUTES
from fcos_lidar_jax.evaluation.results import LIDAR_META
from fcos_lidar_jax.simulation.nuscenes_tables import (
    MAP_FILE,
    SWEEPS_PER_KEYFRAME,
    Row,
    fixed_tables,
    object_rows,
    scene_rows,
)
from fcos_lidar_jax.simulation.world import class_shares

VERSION, SPLIT = "v1.0-trainval", "val"
TRUTHS, PREDICTIONS = 30, 200  # of every keyframe
CATEGORIES = {name: category for category, name in CATEGORY_TO_CLASS.items()}
EGO = {"translation": [411.3039349319818, 1180.8903791765097, 0.0], "rotation": [0.9831, 0.0, 0.0, -0.18307]}
MOUNT = {"translation": [0.9, 0.0, 1.8], "rotation": [1.0, 0.0, 0.0, 0.0]}


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the comparison."""

    samples: int = 6019  # Keyframes, spread over the split's scenes.
    repeats: int = 3  # Runs of our evaluation, for the median; the devkit runs once.


def _make_files(root: Path, samples: int) -> None:
    """Write the tables and the results file; all objects of a scene are in all of its keyframes."""
    scenes = official_splits()[SPLIT]
    rng, tables = np.random.default_rng(0), defaultdict[str, list[Row]](list)
    with (root / "results.json").open("w") as stream:
        stream.write(f'{{"meta": {json.dumps(LIDAR_META)}, "results": {{')
        for index, keyframes in enumerate(np.array_split(np.arange(samples), len(scenes))):
            names = rng.choice(NUSCENES_CLASSES, TRUTHS, p=class_shares(1.0)).tolist()
            rows = _scene(rng, index, names, len(keyframes))
            rows["scene"][0]["name"] = scenes[index]
            classes = {row["token"]: name for row, name in zip(rows["instance"], names, strict=True)}
            truths = defaultdict[str, list[tuple[str, Row]]](list)
            for row in rows["sample_annotation"]:
                truths[row["sample_token"]].append((classes[row["instance_token"]], row))
            found = {token: list(make_predictions(rng, own)) for token, own in truths.items()}
            stream.write(("," if index else "") + json.dumps(found)[1:-1])
            for table, own in rows.items():
                tables[table] += own
        stream.write("}}")
    logs = [row["token"] for row in tables["log"]]
    (root / VERSION).mkdir()
    for table, rows in (tables | fixed_tables(logs)).items():
        with (root / VERSION / f"{table}.json").open("w") as stream:
            json.dump(rows, stream, indent=0)
    (root / MAP_FILE).parent.mkdir()
    (root / MAP_FILE).touch()


def _scene(rng: np.random.Generator, index: int, names: list[str], keyframes: int) -> dict[str, list[Row]]:
    """Make the rows of a scene whose objects stand still or move in straight lines."""
    shape = keyframes, len(names)
    step = rng.choice([0, 2], (len(names), 1)) * rng.normal(0, [1, 1, 0], (len(names), 3))
    start = EGO["translation"] + rng.normal(0, [22, 22, 0], (len(names), 3))
    boxes = np.zeros((*shape, 7))
    boxes[..., :3] = start + np.arange(keyframes)[:, None, None] * step
    boxes[..., 3:6] = rng.uniform(0.5, 4.5, (len(names), 3))
    boxes[..., 6] = rng.uniform(-np.pi, np.pi, len(names))
    attributes = [next(iter(CLASS_ATTRIBUTES[name]), None) for name in names]
    counts = rng.integers(0, 40, shape)
    counts[[0, -1]] += 1  # annotations are from the first to the last point
    objects = [CATEGORIES[name] for name in names], boxes, [attributes] * keyframes, np.ones(shape), counts
    sweeps = (keyframes - 1) * SWEEPS_PER_KEYFRAME + 1
    return scene_rows(0, index, MOUNT, [EGO] * sweeps) | object_rows(0, index, *objects)


def make_predictions(rng: np.random.Generator, truths: list[tuple[str, Row]]) -> Iterator[Row]:
    """Make boxes around the annotations of a keyframe; nearer boxes tend to have higher scores."""
    away = rng.exponential(2.0, (PREDICTIONS, 1)) * rng.normal(0, [1, 1, 0.1], (PREDICTIONS, 3))
    score = np.clip(np.exp(-np.linalg.norm(away, axis=1)) * rng.beta(4, 2, PREDICTIONS), 1e-3, None)
    scale, velocity = rng.uniform(0.8, 1.25, (PREDICTIONS, 3)), rng.normal(0, 2, (PREDICTIONS, 2))
    for i, o in enumerate(rng.integers(0, len(truths), PREDICTIONS)):
        name, truth = truths[o]
        known = CLASS_ATTRIBUTES[name]
        yield {
            "sample_token": truth["sample_token"],
            "translation": (truth["translation"] + away[i]).tolist(),
            "size": (truth["size"] * scale[i]).tolist(),
            "rotation": truth["rotation"],
            "velocity": velocity[i].tolist(),
            "detection_name": name,
            "detection_score": float(score[i]),
            "attribute_name": known[i % len(known)] if known else "",
        }


OURS = """
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.evaluation.metrics import evaluate
from fcos_lidar_jax.evaluation.results import read_results
from fcos_lidar_jax.evaluation.truth import split_truth
data = NuScenes(root, version)
now("tables")
truth = split_truth(data, data.split(split))
boxes = read_results(f"{root}/results.json", truth.tokens).boxes
now("load")
evaluate(boxes, truth)
now("evaluate")
"""
OFFICIAL = """
from nuscenes import NuScenes
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.detection.evaluate import DetectionEval
data = NuScenes(version, root, verbose=False)
now("tables")
config = config_factory("detection_cvpr_2019")
task = DetectionEval(data, config, f"{root}/results.json", split, out, verbose=False)
now("load")
task.main(plot_examples=0, render_curves=False)
now("evaluate")
"""
STAGED = """
import json, sys, time
root, out, version, split = sys.argv[1:]
stages, last = {}, [time.perf_counter(), time.process_time()]
def now(stage):
    wall, cpu = time.perf_counter(), time.process_time()
    stages[f"{stage}_s"], stages[f"{stage}_cpu_s"] = wall - last[0], cpu - last[1]
    last[:] = wall, cpu
"""
"""Start of both programs: measures wall and processor time of the stages, with imports as part of ``tables``."""


def run(command: list[str]) -> tuple[str, dict[str, float]]:
    """Run a process; returns its last output line, wall time and peak memory."""
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = process.stdout.read().splitlines()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"error: {command[0]} ended with {process.returncode}")
    return lines[-1], {"process_s": time.perf_counter() - began, "peak_gib": usage.ru_maxrss / 2**20}


def staged(name: str, code: str, arguments: list[str]) -> dict[str, float]:
    """Run a program; returns its reported times, wall time and memory."""
    line, figures = run([sys.executable, "-c", f"{STAGED}{code}print(json.dumps(stages))", *arguments])
    figures |= json.loads(line)
    for unit in ("s", "cpu_s"):
        figures[f"from_tables_{unit}"] = figures[f"load_{unit}"] + figures[f"evaluate_{unit}"]
    print(f"{name}:", json.dumps(figures), flush=True)
    return figures


def differences(ours: Any, theirs: Any, path: str = "") -> list[str]:
    """List the places where two summaries differ by more than 1e-9."""
    if isinstance(theirs, dict):
        if list(ours) != list(theirs):
            return [f"{path}: keys"]
        keys = [key for key in theirs if key != "eval_time"]
        return [d for key in keys for d in differences(ours[key], theirs[key], f"{path}/{key}")]
    if isinstance(theirs, float):
        return [] if np.isclose(ours, theirs, rtol=0, atol=1e-9, equal_nan=True) else [path]
    return [] if ours == theirs else [path]


def main(args: Args) -> None:
    """Generate the files, run both, compare, and save the figures."""
    with tempfile.TemporaryDirectory() as folder:
        root, began = Path(folder), time.perf_counter()
        _make_files(root, args.samples)
        size = (root / "results.json").stat().st_size
        print(f"generated in {time.perf_counter() - began:.0f} s, results.json of {size / 1e6:.0f} MB", flush=True)
        place = [folder, f"{folder}/official", VERSION, SPLIT]
        theirs = staged("devkit", OFFICIAL, place)
        repeats = [staged("ours", OURS, place) for _ in range(args.repeats)]
        ours = {key: float(np.median([figures[key] for figures in repeats])) for key in repeats[0]}
        flags = ["--data-root", folder, "--version", VERSION, "--split", SPLIT, "--no-report"]
        flags += ["--results", f"{folder}/results.json", "--out", f"{folder}/ours"]
        _, command = run([sys.executable, "-m", "fcos_lidar_jax", "evaluate", *flags])
        files = (root / whose / "metrics_summary.json" for whose in ("ours", "official"))
        summary, official = (json.loads(file.read_text()) for file in files)
    unequal = differences(summary, official)
    compared = {"from the tables in memory": "from_tables_s", "whole process": "process_s"}
    compared["from the tables in memory, processor time"] = "from_tables_cpu_s"
    record: dict[str, Any] = {"samples": args.samples, "truths_a_sample": TRUTHS}
    record |= {"predictions_a_sample": PREDICTIONS, "results_mb": round(size / 1e6)}
    for name, figures in (("ours", ours), ("devkit", theirs), ("command", command)):
        record[name] = {key: round(value, 2) for key, value in figures.items()}
    record["times_as_fast"] = {name: round(theirs[key] / ours[key], 1) for name, key in compared.items()}
    record["nd_score"] = summary["nd_score"]
    record["numbers_that_differ_by_more_than_1e-9"] = unequal
    save(record, args.out)
    if unequal:
        raise ValueError(f"not the official numbers: {', '.join(unequal)}")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
