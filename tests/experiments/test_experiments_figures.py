"""The paper's figures as data, and the experiments that measure those that need no training."""

import numpy as np
import pytest

from experiments.benchmarks import latency, mrv_figures
from experiments.paper import PAPER
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY

ROWS = {name: table["rows"] for name, table in PAPER["tables"].items()}


@pytest.mark.parametrize("table", ROWS)
def test_rows_are_complete_and_their_classes_average_to_the_map(table):
    columns = set(PAPER["tables"][table]["columns"])
    assert PAPER["tables"][table]["place"].startswith(f"table {table[-1]}, section 4")
    for name, row in ROWS[table].items():
        absent = {"time_ms"} if table == "table1" and name.startswith("single") else set()
        assert set(row) - {"note"} == columns - absent, name
        assert {"mAP", "NDS"} <= set(row)
        if "car" in row and (table, name) != ("table8", "CenterPoint"):  # printed so, and noted
            # Both are rounded: ten numbers to 0.1, their mean to 0.1 or finer.
            assert np.mean([row[c] for c in NUSCENES_CLASSES]) == pytest.approx(row["mAP"], abs=0.1), name


def test_counts_of_a_small_cloud():
    """Three points in a cell, the nearest of an older sweep: what is kept can be counted by hand.

    ``test_projection.py`` counts a real cloud.
    """
    cloud = np.zeros((4, 5), np.float32)
    cloud[:3, 1] = 9, 5, 7
    cloud[1:3, 4] = 0.1
    cloud[3, 0] = 60  # out of range
    found = mrv_figures.kept_by_rounds(cloud, NUSCENES_HDL32E, rounds=(1, 2, 5))
    assert (found["in_range"], found["in_view"]) == (3, 3)
    assert found["prioritized"]["kept"] == found["not prioritized"]["kept"] == {"1": 1, "2": 2, "5": 3}
    assert found["prioritized"]["current"] == {"1": 1, "2": 1, "5": 1}
    assert found["not prioritized"]["current"] == {"1": 0, "2": 0, "5": 1}
    assert found["prioritized"]["percent"] == {"1": 33.33, "2": 66.67, "5": 100.0}


def test_ten_sweeps_are_loaded_for_a_preset_of_one():
    with latency.simulated_sweeps(TINY) as (drive, token):
        points = latency.load(drive, token, QUICKSTART, TINY, "multi")
    assert len(points) == latency.ROWS["multi"]
    assert len(np.unique(points[:, 4])) == 10
