"""The ledger of the paper's claims: the paper's figures, our figures, and whether they agree.

    python -m experiments.ledger          # print it
    python -m experiments.ledger --write  # also write it into experiments/README.md

The ledger reads our figures from ``experiments/results``, without training or timing. A claim about accuracy is a
gain of one row of the paper's tables 1, 2, 6 and 7 over another; the other tables have no scores yet. It is asked
of small networks, of the same networks with local geometry, and of these networks with a second look too.
CenterPoint has no local geometry. The verdict follows from the 95 % interval of the gain over the seeds:

- excludes zero, with the paper's sign: agrees; agrees only in direction if it also excludes the paper's figure
- excludes zero, with the other sign: disagrees
- contains zero: undecided; disagrees if it excludes the paper's figure
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.benchmarks.latency import PAPER_STAGES
from experiments.changes import FROZEN_LOOK, Change, as_centerpoint, change
from experiments.paper import PAPER
from experiments.paper_tables.cells import Cell, changes_of, read_cells
from experiments.paper_tables.scales import Simulated, quarter
from experiments.paper_tables.tables import SCORES
from experiments.script import markdown_table, run_script
from experiments.statistics import MIN_SEEDS, gain, seeds_needed
from fcos_lidar_jax.files import atomic_write, read_json

RESULTS = Path(__file__).parent / "results"
README = Path(__file__).parent / "README.md"
_DIRECTION = "agrees only in direction"
_OUR_NDS = (
    "Simulated objects have no attributes, so the attribute error is 1 in every row. The mean velocity error\n"
    "exceeds 1 m/s in all cells that record it (most with local geometry, most of CenterPoint). Both add nothing\n"
    "to NDS of these cells, which is then at most 80. The paper's gains may include gains in these errors."
)
_MARKS = ("<!-- the ledger: python -m experiments.ledger --write -->\n", "<!-- end of the ledger -->\n")


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the ledger."""

    write: bool = False  # Write the ledger into experiments/README.md.


@dataclasses.dataclass(frozen=True)
class Figure:
    """A claim that needs no training."""

    claim: str  # Text of the claim.
    file: str  # Results file, without .json.
    value: Callable[[Any], float]  # Computes our figure from the file's content.
    paper: float  # The paper's figure.
    above: bool = False  # The paper states a lower bound.


def _kept(d: Any, column: str, rounds: int) -> float:
    return d["kept"]["ten sweeps, with close points"]["prioritized"][column][str(rounds)]


def _overall(d: Any, setting: str) -> float:
    return sum(d["times"][setting][stage]["median_ms"] for stage in PAPER_STAGES)


def _paper_ratio(table: str, row: str, reference: str) -> float:
    rows = PAPER["tables"][table]["rows"]
    return rows[row]["time_ms"] / rows[reference]["time_ms"]


FIGURES = [
    Figure("Points that one round keeps, thousands", "mrv_figures", lambda d: _kept(d, "kept", 1) / 1000, 28),
    Figure(
        "Points within the limits that five rounds keep, %",
        "mrv_figures",
        lambda d: _kept(d, "percent", 5),
        50,
        above=True,
    ),
    *(
        Figure(
            f"Time of the projection{where}, ten sweeps: seven rounds relative to one",
            file,
            lambda d: d["times"]["multi"]["7"]["ratio"],
            _paper_ratio("table1", "multi, 7", "multi, 1"),
        )
        for where, file in (("", "mrv_figures"), (" on an H100", "mrv_figures_gpu"))
    ),
    *(
        Figure(
            f"Time of the stem: {row}, relative to nine groups of two convolutions",
            "module_latency",
            lambda d, variant=variant: d["variants"][variant]["ratio"],
            _paper_ratio(table, key, "9 groups" if table == "table3" else "2"),
        )
        for row, variant, table, key in (
            ("one group", "one group", "table3", "1 group"),
            ("five groups", "5 modalities", "table3", "5 groups"),
            ("rounds not grouped", "9 types, rounds apart", "table3", "9 groups, rounds not grouped"),
            ("one convolution", "1 convolution", "table4", "1"),
            ("three convolutions", "3 convolutions", "table4", "3"),
        )
    ),
    Figure(
        "Time of projection, backbone and heads: ten sweeps relative to one",
        "latency",
        lambda d: _overall(d, "multi") / _overall(d, "single"),
        1.0,
    ),
]


class Claim(NamedTuple):
    """A claim about accuracy: what a change of the base gains over another change."""

    text: str
    change: Change
    reference: Change
    paper: tuple[str, str, str]  # Table of the paper, its row and the row's reference.


def _mrv(rounds: int, sweeps: int, priority: bool = True) -> Change:
    return change(num_sweeps=sweeps, projection__num_rounds=rounds, projection__prioritize_current=priority)


CLAIMS = (
    Claim("five rounds instead of one, one sweep", _mrv(5, 1), _mrv(1, 1), ("table1", "single, 5", "single, 1")),
    Claim("five rounds instead of one, ten sweeps", _mrv(5, 10), _mrv(1, 10), ("table1", "multi, 5", "multi, 1")),
    Claim("ten sweeps instead of one, one round", _mrv(1, 10), _mrv(1, 1), ("table1", "multi, 1", "single, 1")),
    Claim("ten sweeps instead of one, five rounds", _mrv(5, 10), _mrv(5, 1), ("table1", "multi, 5", "single, 5")),
    Claim("five rounds, ten sweeps instead of one", _mrv(5, 10), _mrv(1, 1), ("table1", "multi, 5", "single, 1")),
    Claim("priority", _mrv(5, 10), _mrv(5, 10, False), ("table2", "prioritized", "not prioritized")),
    Claim("heads that are not tied", _mrv(5, 10), change(model__tied_heads=True), ("table6", "untied", "tied")),
    Claim(
        "FCOS-LiDAR instead of CenterPoint, ten sweeps",
        _mrv(5, 10),
        as_centerpoint,
        ("table7", "FCOS-LiDAR, multi", "CenterPoint, multi"),
    ),
    Claim(
        "FCOS-LiDAR instead of CenterPoint, one sweep",
        _mrv(5, 1),
        lambda config: as_centerpoint(_mrv(5, 1)(config)),
        ("table7", "FCOS-LiDAR, single", "CenterPoint, single"),
    ),
)
NETWORKS = {
    "small network": change(),
    "with local geometry": change(model__local_geometry=True),
    "with a second look too": change(model__local_geometry=True, refinement=FROZEN_LOOK),
}


def verdict_of_figure(figure: Figure, ours: float) -> str:
    """Compare our figure with the paper's: agreement is within a tenth, or above a lower bound.

    >>> figure = Figure("", "", float, 1.2)
    >>> [verdict_of_figure(figure, ours) for ours in (1.25, 2.0, 0.9)]
    ['agrees', 'agrees only in direction', 'disagrees']
    """
    if figure.above:
        return "agrees" if ours > figure.paper else "disagrees"
    if abs(ours / figure.paper - 1) <= 0.1:
        return "agrees"
    return _DIRECTION if (ours - 1) * (figure.paper - 1) > 0 else "disagrees"


Arms = tuple[list[float], list[float]]
"""Scores in points, one per seed: of a claim's change, and of the reference."""


def verdict(arms: Arms, paper: float) -> tuple[str, str]:
    """Compare a gain with the paper's gain; returns the verdict and the seeds that would settle it.

    An undecided claim names the number of seeds with which the interval would separate the paper's gain from zero
    in about half of the cases, if further seeds have the same deviations.
    """
    bounds = gain(*arms)
    if bounds is None or min(map(len, arms)) < MIN_SEEDS:
        return "undecided", "more seeds"
    _, low, high = bounds
    if low <= 0 <= high and low <= paper <= high:
        return "undecided", f"{seeds_needed(*arms, paper)} seeds"
    if (low > 0 and paper > 0) or (high < 0 and paper < 0):
        return "agrees" if low <= paper <= high else _DIRECTION, ""
    return "disagrees", ""


def arms_of(
    claim: Claim, network: Change, scale: Simulated, cells: Mapping[tuple[str, int], Cell], score: str
) -> Arms:
    """Return the scores of a claim with a network, without diverged cells."""

    def scores(row: Change) -> list[float]:
        own = changes_of(row(network(scale.base)), scale.base)
        of_row = (cell for (name, _), cell in cells.items() if name == own)
        return [100 * cell["scores"][score] for cell in of_row if "scores" in cell]

    return scores(claim.change), scores(claim.reference)


def figure_rows() -> Iterator[list[str]]:
    """Yield the cells of each claim that needs no training."""
    for figure in FIGURES:
        ours = figure.value(read_json(RESULTS / f"{figure.file}.json", dict[str, Any]))
        said = verdict_of_figure(figure, ours)
        paper = f"more than {figure.paper:g}" if figure.above else f"{figure.paper:.3g}"
        source = f"[{figure.file}](results/{figure.file}.json)"
        yield [figure.claim, paper, f"{ours:.3g}", source, said]


def claim_rows(score: str) -> Iterator[list[str]]:
    """Yield the cells of each claim about a score."""
    scale = quarter(Path("unused"))
    cells = read_cells(folder := RESULTS / "tables" / scale.name, scale)
    if not cells:
        raise ValueError(f"{folder}: no cells, expected those of the paper's tables")
    for claim in CLAIMS:
        table, *rows = claim.paper
        theirs, reference = (PAPER["tables"][table]["rows"][row][score] for row in rows)
        paper = round(theirs - reference, 2)
        arms = [arms_of(claim, network, scale, cells, score) for network in NETWORKS.values()]
        yield [claim.text, f"{paper:+.2f}", *(_said(own, paper) if all(own) else "not trained" for own in arms)]


def _said(arms: Arms, paper: float) -> str:
    mean, *bounds = gain(*arms) or (np.mean(arms[0]) - np.mean(arms[1]),)
    ours = f"{mean:+.1f}" + (f" [{bounds[0]:+.1f}, {bounds[1]:+.1f}]" if bounds else "")
    few = min(map(len, arms))
    seeds = f"{few} seed{'s' * (few > 1)}, " if few != MIN_SEEDS else ""
    return f"{ours} {seeds}{': '.join(filter(None, verdict(arms, paper)))}"


def as_markdown() -> str:
    """Format the whole ledger."""
    tables = [markdown_table(("without training", "paper", "here", "from", "verdict"), figure_rows())]
    for score in SCORES:
        tables.append(markdown_table((f"gain in points of {score}", "paper", *NETWORKS), claim_rows(score)))
    return "\n\n".join([*map("\n".join, tables), _OUR_NDS]) + "\n"


def with_ledger(document: str, ledger: str) -> str:
    """Replace what is between the two marks of a document by the ledger."""
    before, begins, rest = document.partition(_MARKS[0])
    _, ends, after = rest.partition(_MARKS[1])
    if not (begins and ends):
        raise ValueError(f"expected the lines {_MARKS[0].strip()} and {_MARKS[1].strip()} around the ledger")
    return f"{before}{_MARKS[0]}\n{ledger}\n{_MARKS[1]}{after}"


def main(args: Args) -> None:
    """Print the ledger, and optionally write it."""
    ledger = as_markdown()
    print(ledger, end="", flush=True)
    if args.write:
        atomic_write(README, with_ledger(README.read_text(encoding="utf-8"), ledger))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
