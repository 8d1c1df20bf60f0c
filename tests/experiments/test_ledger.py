"""The ledger says what the result files say."""

import csv
import itertools
from pathlib import Path

import pytest

from experiments.changes import as_centerpoint, change
from experiments.ledger import (
    CLAIMS,
    NETWORKS,
    README,
    RESULTS,
    arms_of,
    as_markdown,
    claim_rows,
    verdict,
    with_ledger,
)
from experiments.paper_tables.cells import changes_of
from experiments.paper_tables.scales import quarter

SCALE = quarter(Path("unused"))
FOLDER = RESULTS / "tables/sector"


def test_the_document_holds_the_ledger_of_the_files():
    text, ledger = README.read_text(), as_markdown()
    assert with_ledger(text, ledger) == text
    with pytest.raises(ValueError, match=r"expected the lines .* around the ledger"):
        with_ledger(text.replace("<!-- end of", "<!-- the end of"), ledger)
    assert ledger.count("\n| priority | +") == 2


def test_velocity_adds_nothing_to_nds_as_the_ledger_says():
    with (FOLDER / "cells.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["scores.errors.mean.vel_err"]]
    assert rows
    assert all("model.local_geometry=true" in row["changes"] or "pillars." in row["changes"] for row in rows)
    assert min(float(row["scores.errors.mean.vel_err"]) for row in rows) > 1


@pytest.mark.parametrize(
    ("own", "other", "paper", "expected"),
    [
        ([0.4, 0.5, 0.6], [0.0, 0.0, 0.0], 0.5, "agrees"),
        ([0.0, 0.0, 0.0], [0.4, 0.5, 0.6], -0.5, "agrees"),
        ([4.0, 4.1, 4.2], [1.0, 1.1, 0.9], 0.5, "agrees only in direction"),
        ([1.0, 1.1, 0.9], [4.0, 4.1, 4.2], -0.5, "agrees only in direction"),
        ([1.0, 1.1, 0.9], [4.0, 4.1, 4.2], 0.5, "disagrees"),
        ([1.0, 1.1, 0.9], [1.1, 0.9, 1.0], 2.0, "disagrees"),  # no gain, and the paper's is excluded
        ([-3.0, 0.0, 3.0], [0.0, 1.0, -1.0], 2.0, "undecided"),
        ([2.0], [0.0], 2.0, "undecided"),
        ([2.0, 2.01, 2.02], [0.0, 0.01], 2.0, "undecided"),
    ],
)
def test_verdicts(own, other, paper, expected):
    assert verdict((own, other), paper)[0] == expected


def test_an_undecided_claim_names_the_seeds_that_would_decide():
    # Deviation 1 of both: t(0.975, 16) sqrt(2 / 9) = 0.999, t(0.975, 14) sqrt(2 / 8) = 1.072.
    assert verdict(([-0.5, 0.5, 1.5], [-1.0, 0.0, 1.0]), 1.0)[1] == "9 seeds"
    assert verdict(([0.5, -0.5, -1.5], [1.0, 0.0, -1.0]), -1.0)[1] == "9 seeds"
    assert verdict(([-9.0, 0.5, 9.0], [0.0, 0.0, 0.0]), 0.01)[1] == "over 100 seeds"


def test_gains_are_of_the_same_network():
    """From cells written by hand: those with a second look have twice the score."""
    scores = (
        (0.5, change()),
        (0.4, change(projection__num_rounds=1)),
        (0.25, change(projection__num_rounds=1, num_sweeps=1)),
        (0.3, change(num_sweeps=1)),
        (0.6, change(projection__prioritize_current=False)),
    )
    cells = {}
    _, *networks = NETWORKS.values()
    for score, row in scores:
        for factor, network in enumerate(networks, start=1):
            name = changes_of(row(network(SCALE.base)), SCALE.base)
            cells[name, 0] = {"scores": {"mAP": factor * score}}
    for score, network in zip((0.45, 0.7), networks, strict=True):
        name = changes_of(as_centerpoint(network(SCALE.base)), SCALE.base)
        cells[name, 0] = {"scores": {"mAP": score}}
    cells["model.local_geometry=true", 1] = {"diverged": "step 7"}
    gains = {
        claim.text: [
            [round(own - other) for own, other in itertools.product(*arms_of(claim, network, SCALE, cells, "mAP"))]
            for network in NETWORKS.values()
        ]
        for claim in CLAIMS
    }
    assert gains == {
        "five rounds instead of one, one sweep": [[], [5], [10]],
        "five rounds instead of one, ten sweeps": [[], [10], [20]],
        "ten sweeps instead of one, one round": [[], [15], [30]],
        "ten sweeps instead of one, five rounds": [[], [20], [40]],
        "five rounds, ten sweeps instead of one": [[], [25], [50]],
        "priority": [[], [-10], [-20]],
        "heads that are not tied": [[], [], []],
        "FCOS-LiDAR instead of CenterPoint, ten sweeps": [[], [5], [30]],
        "FCOS-LiDAR instead of CenterPoint, one sweep": [[], [], []],
    }


def test_gains_of_the_paper_are_those_of_its_tables():
    gains = [0.28, 2.06, 1.88, 3.66, 3.94, 2.79, 0.64, -3.32, 0.59]
    assert [float(paper) for _, paper, *_ in claim_rows("mAP")] == gains
