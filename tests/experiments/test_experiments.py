"""The tables: rows, differences, intervals, pictures, and what is refused; the example of docs/variant.md."""

import dataclasses
import doctest
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from linear_network import linear_network
from pretended import Pretended
from study_tables import study_tables

from experiments.changes import change
from experiments.paper import PAPER
from experiments.paper_tables import submission as table8
from experiments.paper_tables import tables
from experiments.paper_tables.__main__ import TABLES
from experiments.paper_tables.scales import smoke
from experiments.paper_tables.tables import Args, Row, run_table
from fcos_lidar_jax.presets import NUSCENES

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture
def train_table(tmp_path, monkeypatch):
    """Runs a table on a scale that trains nothing; its files are below ``smoke/``."""

    def run(table, *, scale=None, figures=None, **options):
        monkeypatch.setattr(tables, "make_scale", lambda _: scale or Pretended())
        args = Args(**{"seeds": (0,), "out": tmp_path, "runs": tmp_path, **options})
        return run_table(dataclasses.replace(table, figures=figures), args)

    return run


EXAMPLES = [p.relative_to(EXPERIMENTS.parent) for p in EXPERIMENTS.rglob("*.py") if ">>> " in p.read_text()]


@pytest.mark.parametrize("name", sorted(".".join(p.with_suffix("").parts) for p in EXAMPLES))
def test_the_examples_in_the_docstrings_hold(name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0
    assert result.failed == 0


def test_tables_show_differences_with_intervals_beside_the_papers(tmp_path, train_table, capsys):
    rows = {row["label"]: row for row in train_table(TABLES["table1"], seeds=(0, 1))["rows"]}
    multi, single = rows["multi, 5 rounds"], rows["single, 5 rounds"]
    # Both rows have the variance 0.5, so Welch's t has 2 degrees of freedom: t(0.975, 2) = 4.3027.
    half = 4.3027 * np.sqrt(0.5 / 2 + 0.5 / 2)
    np.testing.assert_allclose(multi["mAP_difference"]["interval"], [40, 40 - half, 40 + half], atol=1e-4)
    assert multi["paper_difference"] == {"mAP": 2.06, "NDS": 1.88}
    assert single["reference"] == "single, 1 round"
    assert single["paper_difference"] == {"mAP": 0.28, "NDS": 1.88}
    assert multi["mAP_difference"]["mean"] == single["mAP_difference"]["mean"] == pytest.approx(40.0)
    text = (tmp_path / "smoke" / "table1.md").read_text()
    assert text in capsys.readouterr().out
    assert "| multi, 5 rounds | 50.50 [44.15, 56.85] | +40.00 [+36.96, +43.04] | 57.08 | +2.06 |" in text
    assert "| multi, 1 round | 10.50 [4.15, 16.85] | - | 55.02 | - |" in text, "no difference to itself"
    assert "would exclude zero" not in text, "two seeds do not tell how many are needed"


def test_a_diverged_cell_is_reported_and_the_others_are_shown(tmp_path, train_table):
    scale = Pretended(diverges=((1, 0), (3, 0), (3, 1)))
    options = {"scale": scale, "seeds": (0, 1, 2)}
    rows = {row["label"]: row for row in train_table(TABLES["table1"], **options)["rows"]}
    # Seeds 1 and 2 are left of one round, seed 2 of three, all of five.
    assert rows["multi, 1 round"]["mAP"]["mean"] == pytest.approx(11.5)
    assert rows["multi, 3 rounds"]["mAP"] == {"mean": pytest.approx(32.0), "interval": None}
    assert rows["multi, 5 rounds"]["mAP"]["mean"] == pytest.approx(51.0)
    assert rows["multi, 5 rounds"]["mAP_difference"]["mean"] == pytest.approx(51.0 - 11.5)
    said = [f"seed {seed}: step 7: loss/l1 is not finite" for seed in (0, 1)]
    assert rows["multi, 3 rounds"]["diverged"] == said
    assert f"multi, 3 rounds: {said[1]}" in (tmp_path / "smoke" / "table1.md").read_text()
    asked = scale.asked
    train_table(TABLES["table1"], **options)
    assert scale.asked == asked
    gone = dataclasses.replace(scale, diverges=tuple((n, 0) for n in (1, 3, 5, 7)))
    record = train_table(TABLES["table1"], scale=gone, out=tmp_path / "gone", runs=tmp_path / "gone")
    assert all(row["mAP"] is None for row in record["rows"])


@pytest.mark.parametrize(
    ("labels", "reference"), [(("untied",), None), (("tied", "tied"), None), (("tied", "untied"), "Tied")]
)
def test_a_table_that_cannot_be_printed_is_refused_before_training(labels, reference):
    rows = tuple(Row(label, change(), reference=reference) for label in labels)
    with pytest.raises(ValueError, match=f"table table6: got rows .*{labels[0]}.*, expected different ones, with"):
        dataclasses.replace(TABLES["table6"], rows=rows)


def test_every_row_has_its_own_configuration_and_its_paper_figures():
    for table in list(TABLES.values())[:6]:
        assert [row.paper for row in table.rows] == list(PAPER["tables"][table.name]["rows"])
        configs = [row.change(NUSCENES) for row in table.rows]
        assert len(set(configs)) == len(configs)
        assert NUSCENES in configs  # the paper's detector is a row of every table


def test_every_row_of_a_study_can_be_trained(tmp_path):
    scale = smoke(tmp_path)
    for table in study_tables():
        configs = [row.change(scale.base) for row in table.rows]
        assert len(set(configs)) == len(configs), table.name
        for config in configs:
            scale.check(config)


def test_table_8_changes_the_heads_and_the_pasting_and_quotes_the_papers_gains(train_table):
    base, fade, c128, both = (row.change(NUSCENES) for row in table8.TABLE.rows)
    assert base == NUSCENES
    assert (fade.fade_epochs, c128.fade_epochs, both.fade_epochs) == (5, 0, 5)
    assert [c.model.head_channels for c in (fade, c128, both)] == [64, 128, 128]
    gains = [row["paper_difference"] for row in train_table(table8.TABLE)["rows"]]
    assert gains == [{}, {"mAP": 2}, {"mAP": 0.6}, {}]


def tiny_smoke(cache):
    """The smoke scale with the sensor and the four steps that the tests of training share."""
    base = change(optimizer__epochs=1)(tiny_run.CONFIG)
    sizes = {"train_frames": tiny_run.STEPS * base.optimizer.batch_size, "test_frames": 1, "evaluations": 1}
    return dataclasses.replace(smoke(cache), base=base, sensor=tiny_run.SENSOR, **sizes)


@pytest.mark.slow
def test_the_table_of_a_variant_of_the_documents_runs(tmp_path, monkeypatch, capsys):
    text = (EXPERIMENTS.parent / "docs" / "variant.md").read_text()
    change_of_config, table = re.findall(r"```(?:python|\{code-block\} python)\n(.*?)```", text, re.DOTALL)[:2]
    code = change_of_config + table.replace(":class: fragment\n", "")
    assert len([line for line in code.splitlines() if line]) <= 16
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tables, "smoke", tiny_smoke)
    with linear_network():
        exec(compile(code, "variant.md", "exec"), {})
    record = json.loads((tmp_path / "outputs" / "tables" / "smoke" / "mine.json").read_text())
    assert [row["label"] for row in record["rows"]] == ["base", "mine"]
    assert all(0 <= row["mAP"]["mean"] <= 100 for row in record["rows"])
    assert "Seven rounds and one head" in capsys.readouterr().out
