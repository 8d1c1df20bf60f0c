"""The ledger says what the result files say."""

import csv
import shutil
from pathlib import Path

import pytest

from experiments.ledger import README, RESULTS, as_markdown, claims, gains_of, verdict, with_ledger
from experiments.paper_tables.paper_rows import PAPER_TABLES
from experiments.paper_tables.scales import quarter

TABLE = PAPER_TABLES[0]


def test_the_document_holds_the_ledger_of_the_files():
    text = README.read_text()
    assert with_ledger(text, as_markdown(RESULTS)) == text


@pytest.mark.parametrize("score", ["mAP", "NDS"])
def test_gains_are_differences_of_cells_that_differ_only_in_the_rounds(score):
    """Five rounds instead of one, by a loop over the rows of the file."""
    folder, found = RESULTS / "tables/sector", {}
    names = {"num_sweeps=1, projection.num_rounds=1": (1, 1), "num_sweeps=1": (1, 5)}
    names |= {"projection.num_rounds=1": (10, 1), "base": (10, 5)}
    with (folder / "cells.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["changes"] in names:
                found[*names[row["changes"]], int(row["seed"])] = float(row[f"scores.{score}"])
    for label, sweeps in (("single, 5 rounds", 1), ("multi, 5 rounds", 10)):
        row = next(row for row in TABLE.rows if row.label == label)
        gains, samples = gains_of(TABLE, row, quarter(Path("unused")), folder, score)
        seeds = [seed for seed in range(100) if {(sweeps, 1, seed), (sweeps, 5, seed)} <= found.keys()]
        assert seeds
        expected = [100 * (found[sweeps, 5, seed] - found[sweeps, 1, seed]) for seed in seeds]
        assert (gains, samples) == (pytest.approx(expected), 8000)


def test_a_claim_is_in_the_ledger_with_its_gain_or_counted_as_not_run():
    ledger, names = as_markdown(RESULTS), [claim for claim, *_ in claims("mAP")]
    assert len(names) == len(set(names)) > 15
    shown = [claim for claim in names if f"| {claim} | 3, 8,000 | " in ledger]
    assert f"\n{len(names) - len(shown)} other claims have no scores" in ledger
    assert shown


def test_velocity_adds_nothing_to_nds_as_the_ledger_says():
    with (RESULTS / "tables/sector/cells.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["scores.errors.mean.vel_err"]]
    assert rows
    assert all("model.local_geometry=true" in row["changes"] or "pillars." in row["changes"] for row in rows)
    assert min(float(row["scores.errors.mean.vel_err"]) for row in rows) > 1


def test_a_seed_without_its_reference_does_not_count(tmp_path):
    assert gains_of(TABLE, TABLE.rows[1], quarter(tmp_path), tmp_path) == ([], 8000)


@pytest.mark.parametrize(
    ("gains", "paper", "expected"),
    [
        ([0.4, 0.5, 0.6], 0.5, "agrees"),
        ([-0.4, -0.5, -0.6], -0.5, "agrees"),
        ([3.0, 3.1, 3.2], 0.5, "agrees only in direction"),
        ([-3.0, -3.1, -3.2], -0.5, "agrees only in direction"),
        ([-3.0, -3.1, -3.2], 0.5, "disagrees"),
        ([-0.1, 0.0, 0.1], 2.0, "disagrees"),  # no gain, and the paper's is excluded
        ([-3.0, 0.0, 3.0], 2.0, "undecided"),
        ([2.0], 2.0, "undecided"),
        ([2.0, 2.01], 2.0, "undecided"),
    ],
)
def test_verdicts(gains, paper, expected):
    assert verdict(gains, paper)[0] == expected


def test_an_undecided_claim_names_the_seeds_that_would_decide():
    # Deviation 1: t(0.975, 5) / sqrt(6) = 1.049, t(0.975, 6) / sqrt(7) = 0.925.
    assert verdict([-0.5, 0.5, 1.5], 1.0)[1].startswith("7 seeds")
    assert verdict([-9.0, 0.5, 9.0], 0.01)[1].startswith("over 100 seeds")


def test_a_document_without_marks_is_refused():
    with pytest.raises(ValueError, match="no marks of the ledger"):
        with_ledger("text", "ledger")


def test_gains_with_local_geometry_are_relative_to_the_row_without_the_addition(tmp_path):
    """Rounds, sweeps and priority, small networks, from cells written by hand."""
    scores = {
        "": 0.5,
        "projection.num_rounds=1": 0.4,
        "num_sweeps=1, projection.num_rounds=1": 0.25,
        "num_sweeps=1": 0.3,
        "projection.prioritize_current=false": 0.6,
        "model.round_offsets=true": 0.7,
    }
    lines = ["changes,seed,scores.mAP,scores.NDS,device,git"]
    for name, score in scores.items():
        changes = ", ".join(sorted(filter(None, ["model.local_geometry=true", name])))
        lines.append(f'"{changes}",0,{score},{score},cpu,abc')
    (tmp_path / "cells.csv").write_text("\n".join(lines) + "\n")
    shutil.copy(RESULTS / "tables/sector/scale.json", tmp_path)
    found = {"small": {}, "compact": {}}
    for claim, table, row, paper in claims("mAP"):
        if "local geometry" in claim:
            size, _, text = claim.rpartition(", ")[2].partition(": ")
            gains, samples = gains_of(table, row, quarter(Path("unused")), tmp_path)
            found[size][text] = ([round(gain) for gain in gains], samples, paper)
    assert found["small"] == {
        "five rounds of ten sweeps instead of one round of ten sweeps": ([10], 8000, 2.06),
        "five rounds of ten sweeps instead of five rounds of one sweep": ([20], 8000, 3.66),
        "five rounds of one sweep instead of one round of one sweep": ([5], 8000, 0.28),
        "one round of ten sweeps instead of one round of one sweep": ([15], 8000, 1.88),
        "five rounds of ten sweeps instead of one round of one sweep": ([25], 8000, 3.94),
        "five rounds of ten sweeps with round offsets instead of one round of ten sweeps": ([30], 8000, 2.06),
        "five rounds of ten sweeps with round offsets instead of one round of one sweep": ([45], 8000, 3.94),
        "with priority instead of without priority": ([-10], 8000, 2.79),
    }
    papers = {text: ([], 16_000, paper) for text, (_, _, paper) in found["small"].items()}
    assert found["compact"] == papers
