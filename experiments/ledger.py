"""The ledger of the paper's claims: the paper's figures, our figures, and whether they agree.

    python -m experiments.ledger          # print it
    python -m experiments.ledger --write  # also write it into experiments/README.md

The ledger reads our figures from ``experiments/results``, without training or timing. A claim about accuracy is a
row of a table of the paper. The claims about rounds, sweeps and priority appear twice more, for networks with
local geometry, which the paper does not have: small networks, and larger ones trained longer in batches of four.
The verdict follows from the 95 % interval of the gain over the seeds:

- excludes zero, with the paper's sign: agrees; agrees only in direction if it also excludes the paper's figure
- excludes zero, with the other sign: disagrees
- contains zero: undecided; disagrees if it excludes the paper's figure
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from experiments.benchmarks.latency import PAPER_STAGES
from experiments.paper import PAPER
from experiments.paper_tables.__main__ import TABLES
from experiments.paper_tables.cells import changes_of, read_cells
from experiments.paper_tables.scales import Simulated, quarter
from experiments.paper_tables.tables import SCORES, Row, Table
from experiments.script import run_script, write_text
from experiments.statistics import MIN_SEEDS, interval, seeds_needed
from experiments.studies import mrv_ablations
from fcos_lidar_jax.files import read_json

RESULTS = Path(__file__).parent / "results"
README = Path(__file__).parent / "README.md"
_DIRECTION = "agrees only in direction"
_OUR_NDS = (
    "Simulated objects have no attributes, so the attribute error is 1 in every row. The mean velocity error\n"
    "exceeds 1 m/s in all cells that record it (most with local geometry, most of CenterPoint). Both add nothing\n"
    "to NDS, which is then at most 80. The paper's gains may include gains in these errors; the gains here do not."
)
_MARKS = ("<!-- the ledger: python -m experiments.ledger --write -->\n", "<!-- end of the ledger -->\n")


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the ledger."""

    results: Path = RESULTS  # Folder of the figures.
    write: bool = False  # Write the ledger into experiments/README.md.


@dataclasses.dataclass(frozen=True)
class Figure:
    """A claim that needs no training."""

    claim: str  # Text of the claim.
    file: str  # Results file, without .json.
    value: Callable[[Any], float]  # Computes our figure from the file's content.
    paper: float  # The paper's figure.
    above: bool = False  # The paper states a lower bound.


def _kept(rounds: int, column: str) -> Callable[[Any], float]:
    return lambda d: d["kept"]["ten sweeps, with close points"]["prioritized"][column][str(rounds)]


def _stem(variant: str) -> Callable[[Any], float]:
    return lambda d: d["variants"][variant]["ratio"]


def _overall(d: Any, setting: str) -> float:
    return sum(d["times"][setting][stage]["median_ms"] for stage in PAPER_STAGES)


def _paper_ratio(table: str, row: str, reference: str) -> float:
    rows = PAPER["tables"][table]["rows"]
    return rows[row]["time_ms"] / rows[reference]["time_ms"]


FIGURES = (
    Figure("Points that one round keeps, thousands", "mrv_figures", lambda d: _kept(1, "kept")(d) / 1000, 28),
    Figure("Points that five rounds keep, %", "mrv_figures", _kept(5, "percent"), 50, above=True),
    Figure(
        "Time of the projection, ten sweeps: seven rounds relative to one",
        "mrv_figures",
        lambda d: d["times"]["multi"]["7"]["ratio"],
        _paper_ratio("table1", "multi, 7", "multi, 1"),
    ),
    *(
        Figure(
            f"Time of the stem: {row}, relative to nine groups of two convolutions",
            "module_latency",
            _stem(variant),
            _paper_ratio(table, key, reference),
        )
        for row, variant, table, key, reference in (
            ("one group", "one group", "table3", "1 group", "9 groups"),
            ("five groups", "5 modalities", "table3", "5 groups", "9 groups"),
            ("rounds not grouped", "9 types, rounds apart", "table3", "9 groups, rounds not grouped", "9 groups"),
            ("one convolution", "1 convolution", "table4", "1", "2"),
            ("three convolutions", "3 convolutions", "table4", "3", "2"),
        )
    ),
    Figure(
        "Time of projection, backbone and heads: ten sweeps relative to one",
        "latency",
        lambda d: _overall(d, "multi") / _overall(d, "single"),
        1.0,
    ),
)

_WITH_OFFSETS = "five rounds of ten sweeps with round offsets"
LOCAL_GEOMETRY = {
    ("five rounds of one sweep", "one round of one sweep"): ("table1", "single, 5", "single, 1"),
    ("five rounds of ten sweeps", "one round of ten sweeps"): ("table1", "multi, 5", "multi, 1"),
    ("five rounds of ten sweeps", "without priority"): ("table2", "prioritized", "not prioritized"),
    ("five rounds of ten sweeps", "five rounds of one sweep"): ("table1", "multi, 5", "single, 5"),
    ("one round of ten sweeps", "one round of one sweep"): ("table1", "multi, 1", "single, 1"),
    ("five rounds of ten sweeps", "one round of one sweep"): ("table1", "multi, 5", "single, 1"),
    (_WITH_OFFSETS, "one round of ten sweeps"): ("table1", "multi, 5", "multi, 1"),
    (_WITH_OFFSETS, "one round of one sweep"): ("table1", "multi, 5", "single, 1"),
}
"""Row and reference in networks with local geometry -> table, row and reference of the paper."""


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


def verdict(gains: list[float], paper: float) -> tuple[str, str]:
    """Compare gains, one per seed, with the paper's gain; returns the verdict and the seeds that would settle it.

    An undecided claim names the number of seeds with which the interval would separate the paper's gain from zero
    in about half of the cases, if further seeds have the same deviation.

    >>> verdict([2.0, 2.1, 2.2], 1.9)
    ('agrees', '')
    >>> verdict([4.0, 4.1, 4.2], 1.9)[0]
    'agrees only in direction'
    >>> verdict([-2.0, -2.1, -2.2], 1.9)
    ('disagrees', '')
    >>> verdict([-1.0, 0.5, 2.0], 1.0)
    ('undecided', '12 seeds')
    >>> verdict([2.0, 2.1], 1.9)  # two seeds say nothing about their spread
    ('undecided', 'more seeds')
    """
    bounds = interval(gains)
    if bounds is None or len(gains) < MIN_SEEDS:
        return "undecided", "more seeds"
    _, low, high = bounds
    if low <= 0 <= high and low <= paper <= high:
        return "undecided", f"{seeds_needed(gains, paper)} seeds"
    if (low > 0 and paper > 0) or (high < 0 and paper < 0):
        return "agrees" if low <= paper <= high else _DIRECTION, ""
    return "disagrees", ""


def gains_of(table: Table, row: Row, scale: Simulated, cells: Path, score: str = "mAP") -> tuple[list[float], int]:
    """Return a row's gains over its reference in points, one per seed with both cells, and the training
    samples."""
    config, reference = (r.change(scale.base) for r in (row, table.reference_of(row)))
    by_changes, gains = read_cells(cells, scale), list[float]()
    changes = [changes_of(c, scale.base) for c in (config, reference)]
    for seed in sorted({seed for _, seed in by_changes}):
        own, other = (by_changes.get((names, seed), {}).get("scores") for names in changes)
        if own and other:
            gains.append(100 * (own[score] - other[score]))
    return gains, scale.train_frames * config.optimizer.epochs


def figure_lines(results: Path) -> Iterator[str]:
    """Yield a line of Markdown for each claim that needs no training."""
    for figure in FIGURES:
        ours = figure.value(read_json(results / f"{figure.file}.json", dict[str, Any]))
        said = verdict_of_figure(figure, ours)
        paper = f"more than {figure.paper:g}" if figure.above else f"{figure.paper:.3g}"
        source = f"[{figure.file}](results/{figure.file}.json)"
        yield f"| {figure.claim} | {paper} | {ours:.3g} | {source} | {said} |"


def claims(score: str) -> Iterator[tuple[str, Table, Row, float]]:
    """Yield claim, table, row and the paper's gain for each row of the paper's tables with a gain in a score."""
    for table in TABLES.values():
        for row in table.rows:
            label, paper = table.reference_of(row).label, table.paper_difference(row).get(score)
            if row.label != label and paper is not None:
                yield f"{table.name}: {row.label} instead of {label}", table, row, paper
    for sizes, ablations in (("small", mrv_ablations.SMALL), ("compact", mrv_ablations.TABLE)):
        rows = {row.label: row for row in ablations.rows}
        for (label, reference), (name, *pair_of_paper) in LOCAL_GEOMETRY.items():
            theirs, base = (PAPER["tables"][name]["rows"][key][score] for key in pair_of_paper)
            row, full = rows[label], label if reference != "without priority" else "with priority"
            claim = f"local geometry, {sizes}: {full} instead of {reference}"
            pair = Table(ablations.name, ablations.title, (rows[reference], row), reference)
            yield claim, pair, row, round(theirs - base, 2)


def training_lines(results: Path) -> tuple[list[str], int]:
    """Return a line of Markdown for each claim about accuracy, and the number of claims without scores."""
    scale, lines, missing = quarter(Path("unused")), list[str](), 0
    papers = {score: {claim: paper for claim, _, _, paper in claims(score)} for score in SCORES}
    for claim, table, row, _ in claims("mAP"):
        cells = [claim]
        for score in SCORES:
            gains, samples = gains_of(table, row, scale, results / "tables" / scale.name, score)
            if gains:
                paper = papers[score][claim]
                mean, *bounds = interval(gains) or (sum(gains) / len(gains),)
                ours = f"{mean:+.1f}" + (f" [{bounds[0]:+.1f}, {bounds[1]:+.1f}]" if bounds else "")
                cells += [f"{len(gains)}, {samples:,}"] if score == "mAP" else []
                cells += [f"{paper:+.2f}", ours, ": ".join(filter(None, verdict(gains, paper)))]
        if len(cells) > 1:
            lines.append(f"| {' | '.join(cells)} |")
        else:
            missing += 1
    return lines, missing


def _table(columns: tuple[str, ...], lines: Iterable[str]) -> str:
    return "\n".join((f"| {' | '.join(columns)} |", f"{'|---' * len(columns)}|", *lines))


def as_markdown(results: Path) -> str:
    """Format the whole ledger."""
    lines, missing = training_lines(results)
    columns = (
        "gain in points",
        "seeds, samples",
        "mAP, paper",
        "here",
        "verdict",
        "NDS, paper",
        "here",
        "verdict",
    )
    parts = [
        _table(("without training", "paper", "here", "from", "verdict"), figure_lines(results)),
        _table(columns, lines),
        f"{missing} other claims have no scores of both rows for a seed.\n\n{_OUR_NDS}",
    ]
    return "\n\n".join(parts) + "\n"


def with_ledger(document: str, ledger: str) -> str:
    """Insert the ledger between its two marks in a document.

    Raises:
        ValueError: the marks are missing.

    >>> print(with_ledger(_MARKS[0] + "old" + _MARKS[1], "new"), end="")
    <!-- the ledger: python -m experiments.ledger --write -->
    <BLANKLINE>
    new
    <!-- end of the ledger -->
    """
    first, last = map(re.escape, _MARKS)
    if not re.search(f"{first}.*{last}", document, re.DOTALL):
        raise ValueError(f"{README}: got no marks of the ledger, expected {_MARKS[0].strip()!r}")
    inside = f"{_MARKS[0]}\n{ledger}\n{_MARKS[1]}"
    return re.sub(f"{first}.*{last}", lambda _: inside, document, flags=re.DOTALL)


def main(args: Args) -> None:
    """Print the ledger, and optionally write it."""
    ledger = as_markdown(args.results)
    print(ledger, end="", flush=True)
    if args.write:
        write_text(README, with_ledger(README.read_text(encoding="utf-8"), ledger))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
