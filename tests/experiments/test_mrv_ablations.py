"""Rounds, sweeps and priority with local geometry: what the rows change."""

import pytest

from experiments.paper_tables.cells import changes_of
from experiments.paper_tables.scales import quarter, smoke
from experiments.studies.mrv_ablations import LONGER, SMALL, SMALL_WITH_SECOND_LOOK, TABLE

CHANGED = {
    "one round of ten sweeps": "projection.num_rounds=1",
    "without priority": "projection.prioritize_current=false",
    "five rounds of one sweep": "num_sweeps=1",
    "one round of one sweep": "num_sweeps=1, projection.num_rounds=1",
    "five rounds of ten sweeps with round offsets": "model.round_offsets=true",
    "without local geometry": "model.local_geometry=false",
}


@pytest.mark.parametrize("table", [TABLE, SMALL, SMALL_WITH_SECOND_LOOK])
@pytest.mark.parametrize("make_scale", [quarter, smoke])
def test_every_row_changes_the_named_part_only(tmp_path, make_scale, table):
    base, second_look = make_scale(tmp_path).base, table is SMALL_WITH_SECOND_LOOK
    whole, *configs = (row.change(base) for row in table.rows)
    assert (whole.num_sweeps, whole.projection.num_rounds, whole.projection.prioritize_current) == (10, 5, True)
    number = len(CHANGED) - 2 * second_look
    assert [changes_of(config, whole) for config in configs] == list(CHANGED.values())[:number]
    assert [row.label for row in table.rows[1:]] == list(CHANGED)[:number]
    larger = base.name == "sector" and table is TABLE
    assert (whole.optimizer.batch_size > base.optimizer.batch_size) is larger
    assert (whole.refinement is not None) is second_look
    assert (changes_of(whole, base) == "model.local_geometry=true") is not (larger or second_look)


def test_a_longer_training_has_twice_the_epochs(tmp_path):
    base = quarter(tmp_path).base
    whole, twice = (row.change(base) for row in LONGER.rows)
    assert whole == SMALL_WITH_SECOND_LOOK.rows[0].change(base)
    assert changes_of(twice, whole) == f"optimizer.epochs={2 * whole.optimizer.epochs}"
