"""Every number of ``metrics_summary.json`` equals the official devkit's, on random data sets."""

import json

import jax
import numpy as np
import pytest
from made_evaluation import SPLIT, VERSION, devkit_summary, make_task, truth_of, write_task

from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.cli.evaluate import Evaluate, run
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.evaluation import evaluate_detections
from fcos_lidar_jax.evaluation.results import LIDAR_META, result_entries
from fcos_lidar_jax.types import Detections

pytestmark = pytest.mark.slow

NuScenesDevkit = pytest.importorskip("nuscenes.nuscenes").NuScenes

TASKS = [
    *({"seed": seed} for seed in range(4)),
    {"seed": 20, "ties": False},
    {"seed": 30, "absent": ("bus", "bicycle", "barrier", "traffic_cone")},
    {"seed": 31, "absent": ("trailer",), "noise": 0.1},
    {"seed": 32, "noise": 0.05, "empty": 0.0},
    {"seed": 33, "samples": 1, "objects": 60},
    {"seed": 34, "samples": 12, "objects": 90},
    {"seed": 35, "objects": 60, "empty": 0.7},
    {"seed": 36, "samples": 3, "objects": 2},
    {"seed": 37, "samples": 2, "objects": 150, "noise": 3.0},
]


def assert_equal(ours, theirs):
    """Including the order of the fields."""

    def assert_near(own, official):
        assert own == pytest.approx(official, abs=1e-12, nan_ok=True)

    ours = {**ours, "eval_time": theirs["eval_time"]}
    assert list(ours) == list(theirs)
    jax.tree.map(assert_near, ours, theirs)


def summaries(root, results, tmp_path, version=VERSION, split=SPLIT):
    """Summaries of our command and of the devkit."""
    official = NuScenesDevkit(version, str(root), verbose=False)
    theirs = devkit_summary(official, results, split, tmp_path / "official")
    place = DataOptions(data_root=root, version=version)
    run(Evaluate(place, tmp_path / "ours", split=split, results=results, report=False))
    return json.loads((tmp_path / "ours" / "metrics_summary.json").read_text()), theirs


@pytest.mark.parametrize("task", TASKS, ids=lambda task: "-".join(f"{k}={v}" for k, v in task.items()))
def test_every_number_equals_the_devkits(task, tmp_path):
    tables, results = make_task(**task)
    root = write_task(tmp_path / "root", tables, results)
    ours, theirs = summaries(root, root / "results.json", tmp_path)
    assert_equal(ours, theirs)
    assert_equal(evaluate_detections(results, truth_of(tables)), theirs)


def test_an_attribute_of_another_class_counts_as_wrong_as_in_the_devkit(tmp_path):
    tables, results = make_task(seed=40)
    boxes = [box for found in results["results"].values() for box in found]
    rng = np.random.default_rng(0)
    for box in boxes:
        box["attribute_name"] = str(rng.choice(["", "vehicle.parked", "pedestrian.moving", "cycle.with_rider"]))
    root = write_task(tmp_path / "root", tables, results)
    assert_equal(*summaries(root, root / "results.json", tmp_path))


@pytest.mark.real_data
def test_every_number_equals_the_devkits_on_a_real_scene(real_data, tmp_path):
    """The detections are real annotations with random offsets and rotations."""
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
    ours, theirs = summaries(root, file, tmp_path, version, split)
    assert_equal(ours, theirs)
    assert theirs["nd_score"] > 0.3
