"""The ledger says what the result files say."""

import json
from pathlib import Path

import pytest

from experiments.ledger import README, RESULTS, as_markdown, gains_of, verdict, with_ledger
from experiments.paper_tables.scales import simulated
from experiments.paper_tables.table1_mrv_rounds import TABLE


def test_the_document_holds_the_ledger_of_the_files():
    text = README.read_text()
    assert with_ledger(text, as_markdown(RESULTS)) == text


def test_gains_are_those_of_the_table():
    tables = RESULTS / "tables" / "simulated"
    recorded = {row["label"]: row for row in json.loads((tables / "table1.json").read_text())["rows"]}
    for row in TABLE.rows:
        gains, samples = gains_of(TABLE, row, simulated(Path("unused")), tables / "cells")
        assert (len(gains), samples) == (3, 2400)
        assert sum(gains) / 3 == pytest.approx(recorded[row.label]["mAP_difference"]["mean"])


def test_a_seed_without_its_reference_does_not_count(tmp_path):
    assert gains_of(TABLE, TABLE.rows[1], simulated(tmp_path), tmp_path) == ([], 2400)


@pytest.mark.parametrize(
    ("gains", "paper", "expected"),
    [
        ([0.4, 0.5, 0.6], 0.5, "agrees"),
        ([-0.4, -0.5, -0.6], -0.5, "agrees"),
        ([3.0, 3.1, 3.2], 0.5, "agrees in direction alone"),
        ([-3.0, -3.1, -3.2], -0.5, "agrees in direction alone"),
        ([-3.0, -3.1, -3.2], 0.5, "disagrees"),
        ([-0.1, 0.0, 0.1], 2.0, "disagrees"),  # no gain, and the paper's is excluded
        ([-3.0, 0.0, 3.0], 2.0, "undecided"),
        ([2.0], 2.0, "undecided"),
    ],
)
def test_verdicts(gains, paper, expected):
    assert verdict(gains, paper)[0] == expected


def test_the_seeds_that_would_decide_shrink_the_interval_to_the_gain():
    # Deviation 1: t(0.975, 5) / sqrt(6) = 1.049, t(0.975, 6) / sqrt(7) = 0.925.
    assert verdict([-0.5, 0.5, 1.5], 1.0)[1].startswith("7 seeds")


def test_more_seeds_than_anybody_trains_are_not_counted():
    assert verdict([-9.0, 0.5, 9.0], 0.01)[1].startswith("over 100 seeds")


def test_a_document_without_marks_is_refused():
    with pytest.raises(ValueError, match="no marks of the ledger"):
        with_ledger("text", "ledger")
