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

from fcos_lidar_jax.commands import prepare
from fcos_lidar_jax.config import NUSCENES, QUICKSTART
from fcos_lidar_jax.data.synthetic.dataset import write_dataset
from fcos_lidar_jax.data.synthetic.render import Order
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.training import NonFiniteLossError

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
    diverges: tuple = ()

    def describe(self):
        return {"scale": self.name}

    def check(self, config):
        pass

    def score(self, config, seed, folder):
        self.asked += 1
        if (config.projection.num_rounds, seed) in self.diverges:
            raise NonFiniteLossError("step 7: loss/l1 is not finite")
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
    assert {"jax", "git", "device", "seed"} <= set(record)


def test_a_cell_names_the_revisions_of_all_who_trained_it(experiments, tmp_path, monkeypatch):
    import grid

    class Interrupted(Pretended):
        def score(self, config, seed, folder):
            if self.asked < 3:
                self.asked += 1
                raise KeyboardInterrupt
            return super().score(config, seed, folder)

    scale = Interrupted()
    for revision in ("a1", "a1", "b2"):
        monkeypatch.setattr(grid, "hardware", lambda revision=revision: {"git": revision})
        with pytest.raises(KeyboardInterrupt):
            grid.run_cell(QUICKSTART, scale, 0, results=tmp_path / "cells", runs=tmp_path)
    record = grid.run_cell(QUICKSTART, scale, 0, results=tmp_path / "cells", runs=tmp_path)
    assert record["git"] == "a1, then b2"
    assert record == grid.run_cell(QUICKSTART, scale, 0, results=tmp_path / "cells", runs=tmp_path)
    assert record["name"] == grid.cell_name(QUICKSTART, scale, 0)


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
            records = grid.run_cells([(held, 0), (free, 0)], scale, **folders)
        finally:
            other.kill()
    assert [record["scores"]["mAP"] for record in records] == pytest.approx([0.3, 0.5])
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
    suppressed = change(inference__nms_form="matrix")(QUICKSTART)
    assert cell_name(suppressed, scale, 0) == cell_name(QUICKSTART, scale, 0)
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
    assert "| multi, 1 round | 10.50 [4.15, 16.85] | - | 55.02 | - |" in text, "no difference to itself"
    assert (tmp_path / "smoke" / "table1.png").read_bytes().startswith(b"\x89PNG")


def test_more_rounds_changes_the_traffic_or_the_epochs_alone(experiments, tmp_path, monkeypatch):
    import more_rounds
    import scales
    import tables

    asked = []
    monkeypatch.setattr(more_rounds, "run_table", lambda table, args: asked.append((table.name, args.scale)))
    more_rounds.main(tables.Args(scale="simulated"))
    more_rounds.main(tables.Args(scale="smoke"))
    assert asked == [
        ("rounds_and_traffic", "calm"),
        ("rounds_and_length", "simulated"),
        ("rounds_and_traffic", "smoke"),
        ("rounds_and_length", "smoke"),
    ]
    hurried, calm = (make(tmp_path) for make in (scales.simulated, scales.calm))
    assert calm == dataclasses.replace(hurried, name="calm", hurry=False)
    cached, quiet = (scale.frames("train", 10).frames for scale in (hurried, calm))
    assert quiet.frames == dataclasses.replace(cached.frames, hurry=False)
    assert quiet.folder != cached.folder
    base = hurried.base
    by_label = {row.label: row.change(base) for row in more_rounds.LENGTH.rows}
    longer = dataclasses.replace(base, optimizer=dataclasses.replace(base.optimizer, epochs=6))
    assert base.optimizer.epochs == 2
    assert by_label["5 rounds, 3 x epochs"] == longer
    assert by_label["1 round, 3 x epochs"].projection.num_rounds == 1
    with pytest.raises(ValueError, match="--scale: got nuscenes, expected smoke or simulated"):
        more_rounds.main(tables.Args(scale="nuscenes"))


def test_a_diverged_cell_is_told_and_the_others_are_shown(experiments, tmp_path, monkeypatch):
    import tables
    from table1_mrv_rounds import TABLE

    scale = Pretended(diverges=((1, 0), (3, 0), (3, 1)))
    monkeypatch.setattr(tables, "make_scale", lambda _: scale)
    table = dataclasses.replace(TABLE, figures=None)
    args = tables.Args(seeds=(0, 1, 2), out=tmp_path, runs=tmp_path)
    rows = {row["label"]: row for row in tables.run_table(table, args)["rows"]}
    # Seeds 1 and 2 are left of one round, seed 2 of three, all of five.
    assert rows["multi, 1 round"]["mAP"]["mean"] == pytest.approx(11.5)
    assert rows["multi, 3 rounds"]["mAP"] == {"mean": pytest.approx(32.0), "interval": None}
    assert rows["multi, 5 rounds"]["mAP"]["mean"] == pytest.approx(51.0)
    assert rows["multi, 5 rounds"]["mAP_difference"]["mean"] == pytest.approx(40.0)
    told = [f"seed {seed}: step 7: loss/l1 is not finite" for seed in (0, 1)]
    assert rows["multi, 3 rounds"]["diverged"] == told
    assert (
        "multi, 3 rounds: seed 1: step 7: loss/l1 is not finite" in (tmp_path / "smoke" / "table1.md").read_text()
    )
    asked = scale.asked
    tables.run_table(table, args)
    assert scale.asked == asked
    gone = dataclasses.replace(scale, diverges=tuple((n, 0) for n in (1, 3, 5, 7)))
    monkeypatch.setattr(tables, "make_scale", lambda _: gone)
    args = tables.Args(seeds=(0,), out=tmp_path / "gone", runs=tmp_path / "gone")
    assert all(row["mAP"] is None for row in tables.run_table(table, args)["rows"])


def test_only_figures_leaves_the_finished_table_alone(experiments, tmp_path, monkeypatch):
    import tables
    from table2_priority import TABLE

    monkeypatch.setattr(tables, "make_scale", lambda _: Pretended())
    table = dataclasses.replace(TABLE, figures=lambda _: {"columns": {"with priority": {"kept": 3.0}}})
    args = tables.Args(seeds=(0,), out=tmp_path, runs=tmp_path)
    tables.run_table(table, args)
    before = (tmp_path / "smoke" / "table2.md").read_text()
    assert "seeds [0]; epochs 40; batch size 2; accumulate 1; precision float32.\n" in before
    assert "interval" not in before, "one seed has none"
    tables.run_table(table, dataclasses.replace(args, only_figures=True))
    assert (tmp_path / "smoke" / "table2.md").read_text() == before
    assert "3.00" in (tmp_path / "smoke" / "table2_figures.md").read_text()


def test_a_picture_of_other_seeds_does_not_stay(experiments, tmp_path, monkeypatch):
    import tables
    from table6_untied_heads import TABLE

    monkeypatch.setattr(tables, "make_scale", lambda _: Pretended())
    picture = tmp_path / "smoke" / "table6.png"
    tables.run_table(TABLE, tables.Args(seeds=(0, 1), out=tmp_path, runs=tmp_path))
    assert picture.exists()
    tables.run_table(TABLE, tables.Args(seeds=(0,), out=tmp_path, runs=tmp_path))
    assert not picture.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": "Tied"}, "got 'Tied', expected one of"),
        ({"rows": ("tied", "tied")}, "got two rows 'tied'"),
        ({"rows": ("tied", "untied"), "paper": "Untied"}, "paper: got 'Untied', expected one of"),
        ({"rows": ("tied", "untied"), "gain": "of_it"}, "gain: got 'of_it', expected one of"),
    ],
)
def test_a_table_that_cannot_be_printed_is_refused_before_training(experiments, change, message):
    import grid
    from table6_untied_heads import TABLE
    from tables import Row

    kinds = {key: change.pop(key) for key in ("paper", "gain") if key in change}
    if "rows" in change:
        change["rows"] = tuple(Row(label, grid.change(), **kinds) for label in change["rows"])
    with pytest.raises(ValueError, match=re.escape(message)):
        dataclasses.replace(TABLE, **change)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_sweeps": 11}, "num_sweeps: got 11, expected 1 to 10"),
        ({"sensor": "kitti_hdl64e"}, "sensor: got 'kitti_hdl64e'"),
        ({"projection__close_m": 2.0}, "projection.close_m: got 2.0, expected 1.0"),
    ],
)
def test_a_simulated_row_that_would_change_nothing_is_refused(experiments, tmp_path, fields, message):
    from grid import change
    from scales import smoke

    scale = smoke(tmp_path)
    scale.check(scale.base)
    with pytest.raises(ValueError, match=re.escape(message)):
        scale.check(change(**fields)(scale.base))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", "0", "0"], "--seeds: got (0, 0), expected different ones, none below 0"),
        (["--data", "nowhere"], "--data: nowhere: no ten_sweep_cloud/cloud.f16.bin there"),
        (["--data-root", "nowhere"], "--data-root: is of --scale nuscenes, got --scale smoke"),
        (["--scale", "calm", "--steps", "5"], "--steps: is of --scale nuscenes, got --scale calm"),
        (["--scale", "nuscenes"], "--data-root: missing, expected the data set for --scale nuscenes"),
        (["--scale", "nuscenes", "--data-root", "nowhere"], "nowhere: no such folder, expected a data root"),
    ],
)
def test_a_users_mistake_is_one_line_before_training(experiments, monkeypatch, capsys, tmp_path, options, message):
    import tables
    from table6_untied_heads import TABLE

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["table6_untied_heads.py", *options])
    with pytest.raises(SystemExit, match="1"):
        tables.command(lambda args: tables.run_table(TABLE, args), None)
    assert capsys.readouterr().err == f"table6_untied_heads.py: error: {message}\n"
    assert list(tmp_path.iterdir()) == []


def test_the_full_scale_trains_and_evaluates_by_the_commands(experiments, tmp_path, monkeypatch):
    import scales

    splits = tmp_path / "splits.json"
    splits.write_text('{"mini_train": ["scene-0001"], "mini_val": ["scene-0002"]}')
    order = Order(2, 1, 3, dataclasses.replace(TINY, name="toy", num_columns=64), False, "v1.0-mini")
    for root in ("one", "two"):
        one = order if root == "one" else dataclasses.replace(order, seed=2)
        write_dataset(one, tmp_path / root, workers=1, report=lambda _: None)
        prepare.run(prepare.Prepare(tmp_path / root, "v1.0-mini", splits=splits))
    asked = []
    monkeypatch.setattr(scales.train_command, "run", asked.append)

    def evaluate(args):
        asked.append(args)
        args.out.mkdir(parents=True)
        summary = {"mean_ap": 0.5, "nd_score": 0.25, "mean_dist_aps": {"car": 0.125}}
        (args.out / "metrics_summary.json").write_text(json.dumps(summary))

    monkeypatch.setattr(scales.evaluate_command, "run", evaluate)
    layout = scales.Layout(tmp_path / "one", "v1.0-mini", splits=splits, steps=5, accumulate=4, workers=2)
    layout = dataclasses.replace(layout, precision="bfloat16")
    scale = scales.NuScenesLayout(layout)
    assert (scale.base.optimizer.accumulate, scale.base.model.precision) == (4, "bfloat16")
    assert scale.score(scale.base, 3, tmp_path / "run") == {"mAP": 0.5, "NDS": 0.25, "AP": {"car": 0.125}}
    trained, evaluated = asked
    assert (trained.train_split, trained.steps, trained.workers, trained.seed) == ("mini_train", 5, 2, 3)
    assert (evaluated.split, evaluated.checkpoint) == ("mini_val", tmp_path / "run")
    # Another data set of the same version is another scale.
    other = scales.NuScenesLayout(dataclasses.replace(layout, data_root=tmp_path / "two"))
    assert other.describe()["fingerprints"] != scale.describe()["fingerprints"]
    with pytest.raises(ValueError, match="wrong"):
        scales.NuScenesLayout(dataclasses.replace(layout, val_split="wrong"))


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


def test_table_8_submits_nothing_of_a_run_that_did_not_end(experiments, tmp_path, monkeypatch):
    import table8_test_submission as table8
    from grid import cell_name, run_cell

    config = table8.wide(table8.faded(QUICKSTART))
    args = table8.Args(seeds=(0,), out=tmp_path, runs=tmp_path / "runs")
    folders = {"results": tmp_path / "smoke" / "cells", "runs": args.runs / "smoke"}
    scale = Pretended()
    monkeypatch.setattr(table8, "make_scale", lambda _: scale)
    run_cell(config, scale, 0, **folders)
    run = folders["runs"] / cell_name(config, scale, 0)
    assert table8.submission(args) == [
        f"No results file: no finished run in {run}, the cell was trained elsewhere."
    ]
    (run / "run.json").write_text('{"num_steps": 20}')
    for step, ended in (("00000010", False), ("00000020", True)):
        (run / "checkpoints" / step).mkdir(parents=True)
        assert table8.finished(run) is ended
    next(folders["results"].iterdir()).write_text('{"seed": 0, "diverged": "step 7: loss/l1 is not finite"}')
    assert table8.submission(args) == ["No results file: the training of seed 0 diverged."]


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
