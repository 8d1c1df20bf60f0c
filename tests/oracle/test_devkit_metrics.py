"""Every number of ``metrics_summary.json`` against the official devkit's, on random data sets."""

import json
import math

import numpy as np
import pytest
from made_evaluation import SPLIT, VERSION, make_task, truth_of, write_task

from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.evaluate import Evaluate, run
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.evaluation import evaluate_detections
from fcos_lidar_jax.evaluation.results import LIDAR_META, result_entries
from fcos_lidar_jax.types import Detections

pytest.importorskip("nuscenes")

TASKS = [
    *({"seed": seed} for seed in range(12)),
    *({"seed": 20 + seed, "ties": False} for seed in range(3)),
    {"seed": 30, "absent": ("bus", "bicycle", "barrier", "traffic_cone")},
    {"seed": 31, "absent": ("trailer",), "noise": 0.1},
    {"seed": 32, "noise": 0.05, "empty": 0.0},
    {"seed": 33, "samples": 1, "objects": 60},
    {"seed": 34, "samples": 12, "objects": 90},
    {"seed": 35, "objects": 60, "empty": 0.7},
    {"seed": 36, "samples": 3, "objects": 2},
    {"seed": 37, "samples": 2, "objects": 150, "noise": 3.0},
]


@pytest.fixture(scope="module")
def devkit():
    """The official evaluation of a data root, written and read again."""
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.detection.evaluate import DetectionEval
    from nuscenes.nuscenes import NuScenes as Official

    def run(root, results, out, version=VERSION, split=SPLIT):
        nusc = Official(version, str(root), verbose=False)
        config = config_factory("detection_cvpr_2019")
        found = DetectionEval(nusc, config, str(results), split, str(out), verbose=False)
        found.main(plot_examples=0, render_curves=False)
        return json.loads((out / "metrics_summary.json").read_text())

    return run


def leaves(value, path=()):
    if isinstance(value, dict):
        return {name: leaf for key, part in value.items() for name, leaf in leaves(part, (*path, key)).items()}
    return {path: value}


def assert_equal(ours, theirs):
    ours, theirs = leaves(ours), leaves(theirs)
    assert list(ours) == list(theirs)
    for path, value in theirs.items():
        if path == ("eval_time",):
            continue
        if isinstance(value, float):
            same = math.isnan(ours[path]) if math.isnan(value) else abs(ours[path] - value) <= 1e-9
            assert same, (path, ours[path], value)
        else:
            assert ours[path] == value, path


@pytest.mark.parametrize("task", TASKS, ids=lambda task: "-".join(f"{k}={v}" for k, v in task.items()))
def test_every_number_is_the_official_one(task, devkit, tmp_path):
    tables, results = make_task(**task)
    root = write_task(tmp_path / "root", tables, results)
    theirs = devkit(root, root / "results.json", tmp_path / "official")
    out = tmp_path / "ours"
    place = DataOptions(data_root=root, version=VERSION)
    run(Evaluate(place, out, split=SPLIT, results=root / "results.json", report=False))
    assert_equal(json.loads((out / "metrics_summary.json").read_text()), theirs)
    assert_equal(evaluate_detections(results, truth_of(tables)), theirs)


@pytest.mark.real_data
def test_every_number_is_the_official_one_on_a_real_scene(real_data, devkit, tmp_path):
    """The real annotations, moved and turned at random, as detections."""
    root, version, split = real_data / "nuscenes_scene0523", "v1.0-scene0523", "scene0523"
    data, rng, results = NuScenes(root, version), np.random.default_rng(0), {}
    for token in data.split(split):
        truth = data.boxes(token)
        boxes = np.repeat(truth.boxes, 2, axis=0).astype(np.float64)
        boxes += rng.normal(0, [0.5, 0.5, 0.2, 0, 0, 0, 0.3, 0.3, 0.3], boxes.shape)
        scores, valid = np.sort(rng.random(len(boxes)))[::-1], rng.random(len(boxes)) < 0.8
        found = Detections(np.nan_to_num(boxes), scores, np.repeat(truth.labels, 2), valid, np.int32(0))
        results[token] = result_entries(found, token, data.sensor_to_global(token))
    file = tmp_path / "results.json"
    file.write_text(json.dumps({"meta": LIDAR_META, "results": results}))
    theirs = devkit(root, file, tmp_path / "official", version, split)
    place = DataOptions(data_root=root, version=version)
    run(Evaluate(place, tmp_path / "ours", split=split, results=file, report=False))
    assert_equal(json.loads((tmp_path / "ours" / "metrics_summary.json").read_text()), theirs)
    assert theirs["nd_score"] > 0.3
