"""The paper's figures as data, and the experiments that measure those that need no training."""

import numpy as np
import pytest

from experiments.benchmarks import latency, loader_speed, module_latency, mrv_figures
from experiments.paper import PAPER
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import StemConfig
from fcos_lidar_jax.sensors import NUSCENES_HDL32E

ROWS = {name: table["rows"] for name, table in PAPER["tables"].items()}
BEST = ("multi, 5", "prioritized", "9 groups", "2", "(1, 3, 6)", "untied", "FCOS-LiDAR, multi")
"""The paper's detector in tables 1 to 7."""


def test_the_papers_detector_has_the_same_scores_in_every_table():
    assert set(ROWS) == {f"table{i}" for i in range(1, 9)}
    best = [ROWS[f"table{i}"][row] for i, row in enumerate(BEST, 1)]
    assert all((row["mAP"], row["NDS"]) == (57.08, 63.15) for row in best)
    by_class = [{name: row[name] for name in NUSCENES_CLASSES} for row in best if "car" in row]
    assert len(by_class) == 4
    assert all(row == by_class[0] for row in by_class)
    assert PAPER["text"]["mAP_five_rounds_as_in_the_text"]["value"] == 57.8


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


def test_rows_that_tables_share_agree():
    single, multi = ROWS["table7"]["FCOS-LiDAR, single"], ROWS["table7"]["FCOS-LiDAR, multi"]
    assert single["mAP"] == ROWS["table1"]["single, 5"]["mAP"]
    assert multi["projection_ms"] == ROWS["table1"]["multi, 5"]["time_ms"]
    assert ROWS["table3"]["9 groups"]["time_ms"] == ROWS["table4"]["2"]["time_ms"]
    for name, row in ROWS["table7"].items():
        parts = row["projection_ms"] + row["backbone_ms"] + row["heads_ms"]
        assert parts == pytest.approx(row["overall_ms"]), name


def test_slips_of_the_source_are_noted_and_quoted_as_printed():
    rows = ROWS["table8"]
    assert (rows["CenterPoint"]["car"], rows["CenterPoint"]["construction_vehicle"]) == (84.6, 17.5)
    assert all(rows[name]["note"] for name in ("CenterPoint", "VISTA", "TransFusion"))
    assert all(rows[name]["bus"] < rows[name]["construction_vehicle"] for name in ("VISTA", "TransFusion"))


def test_counts_of_a_small_cloud():
    """Three points in a cell, the nearest of an older sweep: what is kept can be counted by hand."""
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


def test_times_have_every_row_and_ratios_to_the_first(monkeypatch):
    monkeypatch.setitem(latency.ROWS, "multi", 64)
    monkeypatch.setitem(latency.ROWS, "single", 64)
    cloud = np.array([[3, 3, 3, 3, 0]] * 50, np.float32)
    times = mrv_figures.mrv_times(cloud, NUSCENES_HDL32E, rounds=(1, 2), repeats=2)
    assert {name: list(setting) for name, setting in times.items()} == {"single": ["1", "2"], "multi": ["1", "2"]}
    for setting in times.values():
        assert setting["1"]["ratio"] == 1
        assert 0 < setting["2"]["median_ms"] <= setting["2"]["p99_ms"]


def test_needed_operations_of_the_stem_by_hand():
    pixels = 64 * 1088
    one_by_one = pixels * 288 * 64
    dense = 9 * pixels * 45 * 288 + 9 * pixels * 288 * 288 + one_by_one
    assert module_latency.needed_gflop(StemConfig(groups="all")) == pytest.approx(3 * 2 * dense / 1e9)
    types = 9 * (9 * pixels * 5 * 32 + 9 * pixels * 32 * 32) + one_by_one
    assert module_latency.needed_gflop(StemConfig()) == pytest.approx(3 * 2 * types / 1e9)


@pytest.mark.real_data
def test_the_real_cloud_is_counted_where_it_exists(real_data):
    """More counts of this cloud are in ``test_projection.py``."""
    cloud, label = latency.fused_cloud(real_data, NUSCENES_HDL32E)
    counts = mrv_figures.kept_by_rounds(cloud, NUSCENES_HDL32E, close="none")
    assert label == "real ten-sweep cloud"
    assert counts["in_range"] == pytest.approx(236_510, abs=12)
    assert counts["prioritized"]["kept"]["1"] == pytest.approx(28_195, abs=12)


def test_the_papers_gpus_need_the_samples_of_class_balanced_epochs():
    """40 epochs of the 123,580 samples that class balance makes of 28,130 keyframes, in 26 hours."""
    assert loader_speed._needs(train_step=False)["nuscenes, the paper's 8 GPUs"] == pytest.approx(52.8, abs=0.05)
