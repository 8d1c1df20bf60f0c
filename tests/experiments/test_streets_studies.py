"""Statistics of sweeps against a made cloud, scores by range, and the cells of the streets' ablations."""

import dataclasses

import numpy as np
import pytest
from numpy.random import default_rng

from experiments.real_frames import scores_by_range
from experiments.studies.street_ablations import CELLS, COLUMNS, GROUPS, as_markdown, mixed
from experiments.sweep_statistics import sweep_statistics
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.simulation.streets import CITY, PLAIN
from fcos_lidar_jax.types import Detections


def made_sweep() -> Frame:
    """A road that rises ahead by 0.03, seen by every beam that falls; three posts; one box around a fourth."""
    azimuth, falling = np.meshgrid(np.linspace(-np.pi, np.pi, 1086, endpoint=False), SENSOR.inclinations_rad[12:])
    x, y = np.sin(azimuth), np.cos(azimuth)
    reach = 1.8 / (-np.tan(falling) + 0.03 * y)
    road = np.stack([reach * x, reach * y, reach * np.tan(falling)], axis=-1).reshape(-1, 3)
    road = road[np.hypot(*road[:, :2].T) < 45]
    heights = np.linspace(-1.0, 0.4, 8)
    posts = [np.stack([np.full(8, u), np.full(8, v), heights + 0.03 * v], axis=1) for u, v in POSTS]
    points = np.concatenate([road, *posts])
    points = np.column_stack([points, np.full(len(points), 20.0), np.zeros(len(points))]).astype(np.float32)
    box = np.array([[*POSTS[3], 0, 1, 1, 4, 0, 0, 0]], np.float32)
    return Frame(points, box, np.zeros(1, np.int32), np.full(1, 8, np.int32))


POSTS = ((10.25, 8.25), (-12.25, 5.25), (8.25, -14.25), (-9.25, -9.25))


def test_statistics_of_a_made_sweep():
    found = sweep_statistics(made_sweep(), SENSOR)
    assert found["road rises ahead, rad"] == pytest.approx(0.03, abs=1e-4)
    assert found["road rises to the right, rad"] == pytest.approx(0, abs=1e-4)
    assert found["road below sensor"] == pytest.approx(1.8, abs=1e-3)
    assert (found["clusters up to 1.5 m wide"], found["wider clusters"]) == (3, 0)
    assert found["intensity, 50 %"] == 20
    assert found["boxes at 10-20 m"] == 1
    assert found["% of row 30 filled"] == 0
    assert found["% of row 6 filled"] > 95
    assert found["noise along a row, mm"] < 1
    bands = sum(value for name, value in found.items() if name.endswith("above ground"))
    assert bands == pytest.approx(100)


def test_noise_along_a_row_is_that_of_the_ranges():
    frame, sigma = made_sweep(), 0.01
    range_m = np.linalg.norm(frame.points[:, :3], axis=1, keepdims=True)
    frame.points[:, :3] *= 1 + sigma * default_rng(0).standard_normal(range_m.shape) / range_m
    assert sweep_statistics(frame, SENSOR)["noise along a row, mm"] == pytest.approx(10, rel=0.1)


def test_scores_by_range_see_what_lies_there():
    boxes = np.array([[10, 0, 0, 4, 2, 1.5, 0, 0, 0], [30, 0, 0, 4, 2, 1.5, 0, 0, 0]], np.float32)
    frame = Frame(np.zeros((0, 5), np.float32), boxes, np.zeros(2, np.int32), np.full(2, 9, np.int32))
    none = np.zeros(0)
    found = Detections(boxes[:1], np.ones(1), np.zeros(1, int), np.ones(1, bool), none)
    scores = scores_by_range([found], [frame])
    assert scores["0-20 m"]["AP"] == {"car": pytest.approx(1, abs=1e-6)}
    assert scores["20-40 m"]["AP"] == {"car": 0}
    assert scores["all"]["truths"] == {"car": 2}
    assert 0.3 < scores["all"]["AP"]["car"] < 0.6


def test_the_table_of_the_ablations_has_the_means_over_seeds():
    def cell(value):
        scores = {"all": {"mAP": value, "AP": {"car": 2 * value, "pedestrian": 3 * value}}}
        return {"scores": {test: scores for test, _ in COLUMNS.values()}}

    record = {"plain, 9 steps, seed 0": cell(0.1), "plain, 9 steps, seed 1": cell(0.2), "device": "cpu"}
    lines = as_markdown(record | {"city, 9 steps, seed 0": cell(0.01)}).splitlines()
    assert lines[2] == "| plain | 2 | 15.0 | 15.0 | 30.0 | 15.0 | 30.0 | 30.0 | 45.0 |"
    assert lines[3].startswith("| city | 1 | 1.0 | 1.0 | 2.0 |")
    assert len(lines) == 4


def test_every_difference_of_the_streets_is_in_one_group():
    fields = [field for group in GROUPS.values() for field in group]
    differ = {f.name for f in dataclasses.fields(CITY) if getattr(CITY, f.name) != getattr(PLAIN, f.name)}
    assert sorted(fields) == sorted(differ - {"name"})
    assert len({repr(streets) for streets in CELLS.values()}) == len(CELLS)
    everything = PLAIN
    for group in GROUPS:
        everything = mixed(everything, CITY, group)
    assert dataclasses.replace(everything, name="city") == CITY
