"""The ledger says what the result files say."""

import csv
from pathlib import Path

import pytest

from experiments.ledger import README, RESULTS, as_markdown, claims, gains_of, verdict, with_ledger
from experiments.paper_tables.cells import read_cells
from experiments.paper_tables.scales import quarter

SCALE = quarter(Path("unused"))
FOLDER = RESULTS / "tables/sector"
CLAIMS = {claim.text: claim for claim in claims()}


def test_the_document_holds_the_ledger_of_the_files():
    text, ledger = README.read_text(), as_markdown(RESULTS)
    assert with_ledger(text, ledger) == text
    shown = [claim for claim in CLAIMS if f"| {claim} | 3, 8,000 | " in ledger]
    assert f"\n{len(CLAIMS) - len(shown)} other claims have no scores" in ledger
    assert 10 < len(shown) < len(CLAIMS) - 10


@pytest.mark.parametrize("score", ["mAP", "NDS"])
def test_gains_are_differences_of_cells_that_differ_only_in_the_rounds(score):
    """Five rounds instead of one, by a loop over the rows of the file."""
    found, cells = {}, read_cells(FOLDER, SCALE)
    names = {"num_sweeps=1, projection.num_rounds=1": (1, 1), "num_sweeps=1": (1, 5)}
    names |= {"projection.num_rounds=1": (10, 1), "base": (10, 5)}
    with (FOLDER / "cells.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["changes"] in names:
                found[*names[row["changes"]], int(row["seed"])] = float(row[f"scores.{score}"])
    for label, sweeps in (("single", 1), ("multi", 10)):
        claim = CLAIMS[f"table1: {label}, 5 rounds instead of {label}, 1 round"]
        seeds = [seed for seed in range(100) if {(sweeps, 1, seed), (sweeps, 5, seed)} <= found.keys()]
        assert seeds
        expected = [100 * (found[sweeps, 5, seed] - found[sweeps, 1, seed]) for seed in seeds]
        assert gains_of(claim, SCALE, cells, score) == pytest.approx(expected)
        alone = {key: cell for key, cell in cells.items() if "num_rounds" in key[0]}
        assert gains_of(claim, SCALE, alone, score) == []  # a seed without its reference does not count


def test_velocity_adds_nothing_to_nds_as_the_ledger_says():
    with (FOLDER / "cells.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["scores.errors.mean.vel_err"]]
    assert rows
    assert all("model.local_geometry=true" in row["changes"] or "pillars." in row["changes"] for row in rows)
    assert min(float(row["scores.errors.mean.vel_err"]) for row in rows) > 1


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


def test_gains_with_local_geometry_are_relative_to_the_row_without_the_addition():
    """Rounds, sweeps and priority, small networks, from cells written by hand."""
    scores = {
        "": 0.5,
        "projection.num_rounds=1": 0.4,
        "num_sweeps=1, projection.num_rounds=1": 0.25,
        "num_sweeps=1": 0.3,
        "projection.prioritize_current=false": 0.6,
        "model.round_offsets=true": 0.7,
    }
    cells = {}
    for name, score in scores.items():
        changes = ", ".join(sorted(filter(None, ["model.local_geometry=true", *name.split(", ")])))
        cells[changes, 0] = {"scores": {"mAP": score}}
    found: dict[str, dict] = {"small": {}, "second look": {}, "compact": {}}
    for text, claim in CLAIMS.items():
        if "local geometry" in text:
            size, _, text = text.rpartition(", ")[2].partition(": ")
            gains = [round(gain) for gain in gains_of(claim, SCALE, cells, "mAP")]
            found[size][text] = gains, claim.paper["mAP"]
    assert found["small"] == {
        "five rounds of ten sweeps instead of one round of ten sweeps": ([10], 2.06),
        "five rounds of ten sweeps instead of five rounds of one sweep": ([20], 3.66),
        "five rounds of one sweep instead of one round of one sweep": ([5], 0.28),
        "one round of ten sweeps instead of one round of one sweep": ([15], 1.88),
        "five rounds of ten sweeps instead of one round of one sweep": ([25], 3.94),
        "five rounds of ten sweeps with round offsets instead of one round of ten sweeps": ([30], 2.06),
        "five rounds of ten sweeps with round offsets instead of one round of one sweep": ([45], 3.94),
        "with priority instead of without priority": ([-10], 2.79),
    }
    assert found["compact"] == {text: ([], paper) for text, (_, paper) in found["small"].items()}
    assert found["second look"].items() <= found["compact"].items()
    assert len(found["second look"]) == 6
