"""The runner beneath the tables: cells, intervals, changes; and the ten lines of the README of experiments/."""

import dataclasses
import doctest
import importlib
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fcos_lidar_jax.config import NUSCENES, QUICKSTART

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


@pytest.fixture
def experiments(monkeypatch):
    """The folder's scripts import each other as scripts do."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    yield
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(EXPERIMENTS)):
            del sys.modules[name]


@dataclasses.dataclass
class Pretended:
    """A scale that trains nothing and counts how often it is asked."""

    name: str = "pretended"
    base: object = QUICKSTART
    asked: int = 0

    def describe(self):
        return {"scale": self.name}

    def score(self, config, seed, folder):
        self.asked += 1
        score = 0.1 * config.projection.num_rounds + 0.01 * seed
        return {"mAP": score, "NDS": score / 2, "AP": {}}


def test_a_finished_cell_is_never_run_again(experiments, tmp_path):
    from grid import change, run_cell

    scale = Pretended()
    three = change(projection__num_rounds=3)(QUICKSTART)
    first = run_cell(three, scale, 1, results=tmp_path, runs=tmp_path)
    again = run_cell(dataclasses.replace(three, name="other"), scale, 1, results=tmp_path, runs=tmp_path)
    assert first == again
    assert scale.asked == 1
    run_cell(three, scale, 2, results=tmp_path, runs=tmp_path)
    assert scale.asked == 2
    record = json.loads(next(iter(sorted(tmp_path.glob("*.json")))).read_text())
    assert record["config"]["projection"]["num_rounds"] == 3
    assert {"jax", "git", "device", "minutes", "seed"} <= set(record)


_HOLDER = """
import sys
from pathlib import Path
from claim import claim
with claim(Path(sys.argv[1])) as mine:
    print(mine, flush=True)
    sys.stdin.read()
"""


def test_a_cell_that_another_process_trains_is_left_to_it(experiments, tmp_path, monkeypatch):
    import grid

    held, free = (grid.change(projection__num_rounds=n)(QUICKSTART) for n in (3, 5))
    scale, folders = Pretended(), {"results": tmp_path / "cells", "runs": tmp_path}
    lock = tmp_path / f"{grid.cell_name(held, scale, 0)}.lock"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", _HOLDER, str(lock)], cwd=EXPERIMENTS, **pipes) as other:
        try:
            assert other.stdout.readline() == "True\n"
            assert grid.run_cell(held, scale, 0, **folders) is None
            # The other is killed while this one waits: its cell is free again.
            monkeypatch.setattr(grid.time, "sleep", lambda _: (other.kill(), other.wait()))
            scores = grid.run_cells([(held, 0), (free, 0)], scale, **folders)
        finally:
            other.kill()
    assert [score["mAP"] for score in scores] == pytest.approx([0.3, 0.5])
    assert scale.asked == 2


def test_cells_are_told_apart_by_what_decides_them(experiments):
    from grid import cell_name, change

    scale = Pretended()
    names = {
        cell_name(change(**fields)(QUICKSTART), scale, seed)
        for fields in ({}, {"model__tied_heads": True}, {"projection__prioritize_current": False})
        for seed in (0, 1)
    }
    assert len(names) == 6
    formed = change(model__stem__form="grouped")(QUICKSTART)
    assert cell_name(formed, scale, 0) == cell_name(QUICKSTART, scale, 0)
    assert cell_name(QUICKSTART, Pretended("elsewhere"), 0) not in names


def test_one_sweep_and_ten_see_the_same_streets(experiments, tmp_path):
    from scales import smoke

    scale = smoke(tmp_path)
    one, three, ten = (scale.frames("test", n).frame(0) for n in (1, 3, 10))
    for frame in (one, three):
        np.testing.assert_array_equal(frame.boxes, ten.boxes)
        np.testing.assert_array_equal(frame.labels, ten.labels)
    np.testing.assert_array_equal(one.points, ten.points[ten.points[:, 4] == 0])
    assert np.unique(three.points[:, 4]).tolist() == np.unique(ten.points[:, 4]).tolist()[:3]
    assert len(one.points) < len(three.points) < len(ten.points)


@pytest.mark.parametrize("name", sorted(p.stem for p in EXPERIMENTS.glob("*.py") if ">>> " in p.read_text()))
def test_the_examples_in_the_docstrings_hold(experiments, name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


def test_intervals_are_students(experiments):
    from grid import interval

    values = [3.0, 5.0, 10.0]
    mean, low, high = interval(values)
    error = math.sqrt(sum((v - 6) ** 2 for v in values) / 2 / 3)
    assert (mean, low, high) == pytest.approx((6.0, 6 - 4.302653 * error, 6 + 4.302653 * error))
    assert interval([1.0]) is None


def test_change_replaces_fields_at_any_depth(experiments):
    from grid import change

    changed = change(num_sweeps=1, model__stem__dilations=(1, 1, 1), projection__num_rounds=7)(NUSCENES)
    assert (changed.num_sweeps, changed.model.stem.dilations, changed.projection.num_rounds) == (1, (1, 1, 1), 7)
    assert (
        dataclasses.replace(changed, num_sweeps=10, model=NUSCENES.model, projection=NUSCENES.projection)
        == NUSCENES
    )
    with pytest.raises(TypeError, match="roundz"):
        change(projection__roundz=3)(NUSCENES)


def test_tables_show_differences_seed_by_seed_beside_the_papers(experiments, tmp_path, monkeypatch, capsys):
    import tables
    from table1_mrv_rounds import TABLE

    monkeypatch.setattr(tables, "make_scale", lambda _: Pretended())
    table = dataclasses.replace(TABLE, figures=None)
    args = tables.Args(seeds=(0, 1), out=tmp_path, runs=tmp_path)
    record = tables.run_table(table, args)
    row = next(row for row in record["rows"] if row["label"] == "multi, 5 rounds")
    assert row["mAP_difference"]["mean"] == pytest.approx(40.0)
    np.testing.assert_allclose(row["mAP_difference"]["interval"], [40.0] * 3)
    assert row["paper_difference"] == {"mAP": 2.06, "NDS": 1.88}
    single = next(row for row in record["rows"] if row["label"] == "single, 5 rounds")
    assert single["reference"] == "single, 1 round"
    assert single["mAP_difference"]["mean"] == pytest.approx(40.0)
    assert single["paper_difference"] == {"mAP": 0.28, "NDS": 1.88}
    text = (tmp_path / "smoke" / "table1.md").read_text()
    assert text in capsys.readouterr().out
    assert "| multi, 5 rounds | 50.50 [44.15, 56.85] | +40.00 [+40.00, +40.00] | 57.08 | +2.06 |" in text
    assert (tmp_path / "smoke" / "table1.png").read_bytes().startswith(b"\x89PNG")


def test_every_row_of_the_tables_has_its_paper_figures(experiments):
    import tables
    from table1_mrv_rounds import TABLE as TABLE_1
    from table2_priority import TABLE as TABLE_2
    from table3_modality_groups import TABLE as TABLE_3
    from table4_num_convs import TABLE as TABLE_4
    from table5_dilations import TABLE as TABLE_5
    from table6_untied_heads import TABLE as TABLE_6

    for table in (TABLE_1, TABLE_2, TABLE_3, TABLE_4, TABLE_5, TABLE_6):
        paper = tables.PAPER["tables"][table.name]["rows"]
        assert [row.paper for row in table.rows] == list(paper)
        assert table.reference in [row.label for row in table.rows]
        configs = [row.change(NUSCENES) for row in table.rows]
        assert len(set(configs)) == len(configs)
        assert NUSCENES in configs  # the paper's detector is a row of every table


def test_table_8_changes_the_heads_and_the_pasting_and_quotes_the_papers_gains(experiments, tmp_path, monkeypatch):
    import tables
    from table8_test_submission import TABLE

    base, fade, c128, both = (row.change(NUSCENES) for row in TABLE.rows)
    assert base == NUSCENES
    assert (fade.fade_epochs, c128.fade_epochs, both.fade_epochs) == (5, 0, 5)
    assert [c.model.head_channels for c in (fade, c128, both)] == [64, 128, 128]
    monkeypatch.setattr(tables, "make_scale", lambda _: Pretended())
    table = dataclasses.replace(TABLE, figures=None)
    record = tables.run_table(table, tables.Args(seeds=(0,), out=tmp_path, runs=tmp_path))
    gains = [row["paper_difference"] for row in record["rows"]]
    assert gains == [{}, {"mAP": 2}, {"mAP": 0.6}, {}]


def test_the_variant_of_the_readme_runs(experiments, tmp_path, monkeypatch, capsys):
    text = (EXPERIMENTS / "README.md").read_text()
    code = re.search(r"## Your own variant\n\n```python\n(.*?)```", text, re.DOTALL)
    assert code is not None
    assert len([line for line in code[1].splitlines() if line]) <= 12
    monkeypatch.chdir(tmp_path)
    exec(compile(code[1], "README.md", "exec"), {})
    record = json.loads((tmp_path / "outputs" / "tables" / "smoke" / "mine.json").read_text())
    assert [row["label"] for row in record["rows"]] == ["base", "mine"]
    assert all(0 <= row["mAP"]["mean"] <= 100 for row in record["rows"])
    assert "Seven rounds and one head" in capsys.readouterr().out
