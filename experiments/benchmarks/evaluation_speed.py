"""How fast is the evaluation beside the official devkit's, on the same files, and how much memory does it take?

    pip install --no-deps nuscenes-devkit==1.2.0
    pip install opencv-python-headless scikit-learn cachetools pyquaternion tqdm
    python -m experiments.benchmarks.evaluation_speed

Generates a data set and a results file of the size of nuScenes val (6,019 keyframes in 150 scenes, 30 annotations
and 200 predictions each), then evaluates it with both, one after the other in processes of their own. Every number
of both must be the same. Two times are compared: from the tables in memory to the summary, which is the devkit's
``DetectionEval`` without curves; and the whole process, from the start of Python to its end. The command
``fcos-lidar evaluate --results FILE`` is run too, for its time and memory.

Cost: about five minutes, 1.5 GB of disk, 3 GB of memory. Expected: at least 20 times as fast from the tables on,
and below 2 GiB.
"""

import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from experiments.script import run_script, save
from fcos_lidar_jax.data.nuscenes.names import CATEGORY_TO_CLASS
from fcos_lidar_jax.data.nuscenes.splits import scenes_of_split
from fcos_lidar_jax.evaluation.boxes import CLASS_ATTRIBUTES
from fcos_lidar_jax.evaluation.results import LIDAR_META
from fcos_lidar_jax.types import CLASSES

VERSION, SPLIT = "v1.0-trainval", "val"
SHARES = np.array([0.43, 0.08, 0.02, 0.02, 0.02, 0.2, 0.02, 0.02, 0.09, 0.1])
"""Of the classes, about as in nuScenes."""
Rows = list[dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Args:
    """How large, and where."""

    samples: int = 6019
    """Keyframes, spread over the split's scenes."""
    truths: int = 30
    """Annotations of each."""
    predictions: int = 200
    """Predictions for each."""
    repeats: int = 3
    """Runs of ours, of which the median counts; the devkit runs once."""
    folder: Path | None = None
    """For the generated files; by default a temporary one."""
    out: Path = Path("outputs/evaluation_speed.json")
    """Where the figures go."""


def make_files(root: Path, args: Args) -> None:
    """Tables and ``results.json``."""
    tables = root / VERSION
    tables.mkdir(parents=True)
    scenes = scenes_of_split(SPLIT, tables)
    rng = np.random.default_rng(0)
    rows: dict[str, Rows] = {"scene": [], "sample": [], "sample_data": [], "ego_pose": []}
    rows |= {"instance": [], "sample_annotation": []}
    category = {name: kind for kind, name in reversed(CATEGORY_TO_CLASS.items())}
    names = sorted({a for known in CLASS_ATTRIBUTES.values() for a in known})
    with (root / "results.json").open("w") as stream:
        stream.write(f'{{"meta": {json.dumps(LIDAR_META)}, "results": {{')
        for s, part in enumerate(np.array_split(np.arange(args.samples), len(scenes))):
            boxes = make_scene(rows, rng, f"{s:03d}", scenes[s], len(part), args)
            for token, found in boxes.items():
                stream.write(f"{'' if token == '000-000' else ','}\n{json.dumps(token)}: {json.dumps(found)}")
        stream.write("}}\n")
    fixed: dict[str, Rows] = {
        "category": [{"token": name, "name": kind, "description": ""} for name, kind in category.items()],
        "attribute": [{"token": name, "name": name, "description": ""} for name in names],
        "visibility": [],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"}],
        "calibrated_sensor": [
            {
                "token": "mount",
                "sensor_token": "lidar",
                "translation": [0.9, 0.0, 1.8],
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "camera_intrinsic": [],
            }
        ],
        "log": [],
        "map": [{"token": "map", "log_tokens": [], "category": "semantic_prior", "filename": "map.png"}],
    }
    (root / "map.png").touch()
    for name, table in {**fixed, **rows}.items():
        (tables / f"{name}.json").write_text(json.dumps(table))


def make_scene(
    rows: dict[str, Rows], rng: np.random.Generator, s: str, name: str, length: int, args: Args
) -> dict[str, Rows]:
    """One scene's rows are appended; its predictions returned."""
    samples = [f"{s}-{k:03d}" for k in range(length)]
    rows["scene"].append({"token": s, "name": name, "log_token": "", "first_sample_token": samples[0]})
    egos = rng.uniform(300, 2000, 3) + np.cumsum(rng.normal(0, 3, (length, 3)), axis=0)
    kinds = rng.choice(len(CLASSES), args.truths, p=SHARES)
    starts = egos[0] + np.pad(rng.normal(0, 22, (args.truths, 2)), ((0, 0), (0, 1)))
    speeds = rng.choice([0.0, 4.0], (args.truths, 1)) * rng.normal(0, 1, (args.truths, 2))
    sizes = rng.uniform(0.5, 4.5, (args.truths, 3))
    turns = quaternions(rng.uniform(-np.pi, np.pi, args.truths))
    for o, kind in enumerate(kinds):
        rows["instance"].append({"token": f"{s}o{o:02d}", "category_token": CLASSES[kind]})
    results: dict[str, Rows] = {}
    for k, token in enumerate(samples):
        around = {"prev": samples[k - 1] if k else "", "next": samples[k + 1] if k + 1 < length else ""}
        time_us = 1_530_000_000_000_000 + int(s) * 10**9 + k * 500_000
        rows["sample"].append({"token": token, "timestamp": time_us, "scene_token": s, **around})
        rows["ego_pose"].append(
            {
                "token": token,
                "timestamp": time_us,
                "translation": egos[k].tolist(),
                "rotation": [1.0, 0.0, 0.0, 0.0],
            }
        )
        rows["sample_data"].append(
            {
                "token": token,
                "sample_token": token,
                "ego_pose_token": token,
                "calibrated_sensor_token": "mount",
                "timestamp": time_us,
                "fileformat": "pcd",
                "is_key_frame": True,
                "filename": f"samples/LIDAR_TOP/{token}.pcd.bin",
                **around,
            }
        )
        centres = starts + np.pad(speeds * k / 2, ((0, 0), (0, 1)))
        for o, kind in enumerate(kinds):
            known = CLASS_ATTRIBUTES[CLASSES[kind]]
            rows["sample_annotation"].append(
                {
                    "token": f"{token}o{o:02d}",
                    "sample_token": token,
                    "instance_token": f"{s}o{o:02d}",
                    "visibility_token": "",
                    "attribute_tokens": [known[o % len(known)]] if known else [],
                    "translation": centres[o].tolist(),
                    "size": sizes[o].tolist(),
                    "rotation": turns[o].tolist(),
                    "prev": f"{around['prev']}o{o:02d}" if k else "",
                    "next": f"{around['next']}o{o:02d}" if around["next"] else "",
                    "num_lidar_pts": int(rng.integers(0, 40)),
                    "num_radar_pts": 0,
                }
            )
        results[token] = make_predictions(rng, token, kinds, centres, sizes, turns, args.predictions)
    return results


def quaternions(yaw: np.ndarray) -> np.ndarray:
    """w, x, y, z of turns about the vertical."""
    return np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)


def make_predictions(
    rng: np.random.Generator,
    token: str,
    kinds: np.ndarray,
    centres: np.ndarray,
    sizes: np.ndarray,
    turns: np.ndarray,
    number: int,
) -> Rows:
    """Boxes about the truths, near and far, the nearer the likelier to score high."""
    source = rng.integers(0, len(kinds), number)
    away = rng.exponential(2.0, (number, 1)) * rng.normal(0, 1, (number, 3)) * [1, 1, 0.1]
    score = np.clip(np.exp(-np.linalg.norm(away, axis=1)) * rng.beta(4, 2, number), 1e-3, None)
    where = centres[source] + away
    size = sizes[source] * rng.uniform(0.8, 1.25, (number, 3))
    velocity = rng.normal(0, 2, (number, 2))
    boxes = []
    for i, o in enumerate(source):
        name = CLASSES[kinds[o]]
        known = CLASS_ATTRIBUTES[name]
        boxes.append(
            {
                "sample_token": token,
                "translation": where[i].tolist(),
                "size": size[i].tolist(),
                "rotation": turns[o].tolist(),
                "velocity": velocity[i].tolist(),
                "detection_name": name,
                "detection_score": float(score[i]),
                "attribute_name": known[i % len(known)] if known else "",
            }
        )
    return boxes


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
"""Before either: wall and processor time of its stages; importing the packages counts as reading the tables."""


def run(command: list[str]) -> tuple[str, dict[str, float]]:
    """Last line of the output, wall time and peak memory of a process."""
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
    """The times that a program tells, its wall time and its memory."""
    code = f"{STAGED}{code}print(json.dumps(stages))"
    line, figures = run([sys.executable, "-c", code, *arguments])
    figures |= json.loads(line)
    for unit in ("s", "cpu_s"):
        figures[f"from_tables_{unit}"] = figures[f"load_{unit}"] + figures[f"evaluate_{unit}"]
    print(f"{name}:", json.dumps(figures), flush=True)
    return figures


def rounded(figures: dict[str, float]) -> dict[str, float]:
    """To hundredths."""
    return {key: round(value, 2) for key, value in figures.items()}


def differences(ours: Any, theirs: Any, path: str = "") -> list[str]:
    """Where two summaries are not the same to 1e-9."""
    if isinstance(theirs, dict):
        if list(ours) != list(theirs):
            return [f"{path}: keys"]
        return [
            d for key in theirs if key != "eval_time" for d in differences(ours[key], theirs[key], f"{path}/{key}")
        ]
    if isinstance(theirs, float):
        same = math.isnan(ours) if math.isnan(theirs) else abs(ours - theirs) <= 1e-9
        return [] if same else [path]
    return [] if ours == theirs else [path]


def main(args: Args) -> None:
    """Generate, run both, compare, write the figures."""
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        root, began = Path(folder), time.perf_counter()
        make_files(root, args)
        size = (root / "results.json").stat().st_size
        print(f"generated in {time.perf_counter() - began:.0f} s, results.json of {size / 1e6:.0f} MB", flush=True)
        place = [folder, f"{folder}/official", VERSION, SPLIT]
        theirs = staged("devkit", OFFICIAL, place)
        repeats = [staged("ours", OURS, place) for _ in range(args.repeats)]
        ours = {key: float(np.median([figures[key] for figures in repeats])) for key in repeats[0]}
        flags = ["--data-root", folder, "--version", VERSION, "--split", SPLIT, "--no-report"]
        flags += ["--results", f"{folder}/results.json", "--out", f"{folder}/ours"]
        _, command = run([sys.executable, "-m", "fcos_lidar_jax", "evaluate", *flags])
        print("command:", json.dumps(command), flush=True)
        summary = json.loads((root / "ours" / "metrics_summary.json").read_text())
        official = json.loads((root / "official" / "metrics_summary.json").read_text())
    unequal = differences(summary, official)
    record = {
        "samples": args.samples,
        "truths_a_sample": args.truths,
        "predictions_a_sample": args.predictions,
        "results_mb": round(size / 1e6),
        "ours": rounded(ours),
        "devkit": rounded(theirs),
        "command": rounded(command),
        "times_as_fast": {
            "from the tables in memory": round(theirs["from_tables_s"] / ours["from_tables_s"], 1),
            "from the tables in memory, processor time": round(
                theirs["from_tables_cpu_s"] / ours["from_tables_cpu_s"], 1
            ),
            "whole process": round(theirs["process_s"] / ours["process_s"], 1),
        },
        "nd_score": summary["nd_score"],
        "numbers_that_differ_by_more_than_1e-9": unequal,
    }
    save(record, args.out)
    if unequal:
        raise ValueError(f"not the official numbers: {', '.join(unequal)}")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
