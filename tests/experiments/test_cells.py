"""Cells of the paper's tables: told apart by what they change, found again, refused where their scale changed."""

import dataclasses
import json

import pytest
from pretended import Pretended
from study_tables import study_tables

from experiments.changes import change
from experiments.ledger import RESULTS
from experiments.paper_tables.__main__ import TABLES
from experiments.paper_tables.cells import add_cell, changes_of, read_cells, run_name
from experiments.paper_tables.scales import quarter
from experiments.paper_tables.tables import as_markdown, make_record
from fcos_lidar_jax.checkpoints.storage import LATER_FIELDS
from fcos_lidar_jax.config import RefinementConfig
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT, QUICKSTART

SECTOR = RESULTS / "tables" / "sector"
CELL = {"changes": "base", "seed": 0, "scores": {"mAP": 0.1, "AP": {}, "curve": [[1, 0.1]]}, "git": "1234567"}


def test_committed_tables_are_those_of_their_cells_and_of_the_rows_of_today(tmp_path):
    scale, tables = quarter(tmp_path), {table.name: table for table in (*TABLES.values(), *study_tables())}
    changes = {
        (name, row.label): changes_of(row.change(scale.base), scale.base)
        for name, table in tables.items()
        for row in table.rows
    }
    cells = read_cells(SECTOR, scale)
    assert len(cells) == len((SECTOR / "cells.csv").read_text().splitlines()) - 1 > 20
    assert {name for name, _ in cells} <= {*changes.values()}
    files = sorted(SECTOR.glob("*.md"))
    assert len(files) == 8
    for file in files:
        record = json.loads(file.with_suffix(".json").read_text())
        table = tables[record["table"]].only(tuple(row["label"] for row in record["rows"]))
        by_row = {r.label: [cells[changes[table.name, r.label], s] for s in record["seeds"]] for r in table.rows}
        again = make_record(table, record["scale"], scale, by_row, record["figures"])
        assert as_markdown(table, again) == file.read_text(), file


def test_long_names_are_cut_and_differ():
    configs = CENTERPOINT_COMPACT, change(pillars__min_radius=3)(CENTERPOINT_COMPACT)
    first, second = (run_name(changes_of(config, QUICKSTART), 0) for config in configs)
    assert first != second
    assert max(len(first), len(second)) < 110


def test_a_cell_comes_back_as_it_was_and_others_stay(tmp_path):
    scale, other = Pretended(), {**CELL, "seed": 1, "diverged": "step 7, loss: not finite"}
    del other["scores"]
    assert read_cells(tmp_path, scale) == {}
    for cell in (other, CELL):
        assert add_cell(tmp_path, scale, cell, locks=tmp_path) == cell
    assert list(read_cells(tmp_path, scale).values()) == [CELL, other]
    assert (tmp_path / "cells.csv").read_text().count("\n") == 3


def test_cells_of_another_scale_are_refused_and_the_field_is_named(tmp_path):
    scale = Pretended()
    add_cell(tmp_path, scale, CELL, locks=tmp_path)
    rounds = dataclasses.replace(scale, base=change(projection__num_rounds=3)(QUICKSTART))
    with pytest.raises(ValueError, match=r"scale\.json: base\.projection\.num_rounds: got 1, expected 3: "):
        read_cells(tmp_path, rounds)
    with pytest.raises(ValueError, match=r"data\.scale: got 'pretended', expected 'elsewhere'"):
        read_cells(tmp_path, dataclasses.replace(scale, name="elsewhere"))
    assert read_cells(tmp_path, dataclasses.replace(scale, base=change(name="other")(QUICKSTART)))


def test_a_later_field_of_the_configuration_refuses_only_what_it_changes(tmp_path):
    earlier = {(section, field): v for section, fields in LATER_FIELDS.items() for field, v in fields.items()}
    defaults = {f"{section}__{field}": value for (section, field), value in earlier.items()}
    whole = change(refinement=RefinementConfig())(QUICKSTART)
    scale = Pretended(base=change(**defaults)(whole))
    add_cell(tmp_path, scale, CELL, locks=tmp_path)
    file = tmp_path / "scale.json"
    record = json.loads(file.read_text())
    for section, field in earlier:
        record["base"][section].pop(field, None)
    file.write_text(json.dumps(record))
    assert read_cells(tmp_path, scale)
    flipped = dataclasses.replace(scale, base=change(**defaults | {"inference__flips": "y"})(whole))
    with pytest.raises(ValueError, match=r"base\.inference\.flips: got 'none', expected 'y'"):
        read_cells(tmp_path, flipped)
