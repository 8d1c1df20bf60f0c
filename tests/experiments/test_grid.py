"""Cells: trained once, by one process, and told of whatever becomes of them."""

import contextlib
import dataclasses

import pytest
from pretended import Pretended

from experiments.changes import change
from experiments.paper_tables import grid
from experiments.paper_tables.cells import run_name
from experiments.paper_tables.grid import run_cell, run_cells
from fcos_lidar_jax.files import file_lock
from fcos_lidar_jax.presets import QUICKSTART


def test_a_finished_or_diverged_cell_is_never_run_again(tmp_path):
    scale, folders = Pretended(diverges=((3, 2),)), {"results": tmp_path, "runs": tmp_path}
    three = change(projection__num_rounds=3)(QUICKSTART)
    for config in (three, dataclasses.replace(three, name="other")):
        first, second = (run_cell(config, scale, seed, **folders) for seed in (1, 2))
    assert scale.asked == 2
    assert first["changes"] == "projection.num_rounds=3"
    assert {"jax", "git", "device", "seed"} <= set(first)
    assert first["scores"]["mAP"] == pytest.approx(0.31)
    assert second["diverged"] == "step 7: loss/l1 is not finite"


def test_a_cell_names_the_revisions_of_all_who_trained_it(tmp_path, monkeypatch):
    class Interrupted(Pretended):
        def score(self, config, seed, folder):
            if self.asked < 3:
                self.asked += 1
                raise KeyboardInterrupt
            return super().score(config, seed, folder)

    scale, folders = Interrupted(), {"results": tmp_path / "cells", "runs": tmp_path}
    for revision in ("a1", "a1", "b2"):
        monkeypatch.setattr(grid, "hardware", lambda revision=revision: {"git": revision})
        with pytest.raises(KeyboardInterrupt):
            run_cell(QUICKSTART, scale, 0, **folders)
    record = run_cell(QUICKSTART, scale, 0, **folders)
    assert record["git"] == "a1, then b2"
    assert record == run_cell(QUICKSTART, scale, 0, **folders)
    assert (tmp_path / run_name("base", 0) / "revisions.txt").read_text() == "a1\nb2"


def test_a_cell_that_another_process_trains_is_left_to_it(tmp_path, monkeypatch):
    held, free = (change(projection__num_rounds=n)(QUICKSTART) for n in (3, 5))
    scale, folders = Pretended(), {"results": tmp_path / "cells", "runs": tmp_path}
    with contextlib.ExitStack() as other:
        assert other.enter_context(file_lock(tmp_path / f"{run_name('projection.num_rounds=3', 0)}.lock"))
        assert run_cell(held, scale, 0, **folders) is None
        # The other ends while this one waits: its cell is free again.
        monkeypatch.setattr(grid.time, "sleep", lambda _: other.close())
        records = run_cells([(held, 0), (free, 0)], scale, **folders)
    assert [record["scores"]["mAP"] for record in records] == pytest.approx([0.3, 0.5])
    assert scale.asked == 2
