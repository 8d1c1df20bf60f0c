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
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from experiments.benchmarks.latency import PAPER_STAGES
from experiments.paper import PAPER
from experiments.paper_tables.__main__ import TABLES
from experiments.paper_tables.cells import Cell, changes_of, read_cells
from experiments.paper_tables.scales import Simulated, quarter
from experiments.paper_tables.tables import SCORES, Row
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


def _kept(d: Any, column: str, rounds: int) -> float:
    return d["kept"]["ten sweeps, with close points"]["prioritized"][column][str(rounds)]


def _overall(d: Any, setting: str) -> float:
    return sum(d["times"][setting][stage]["median_ms"] for stage in PAPER_STAGES)


def _paper_ratio(table: str, row: str, reference: str) -> float:
    rows = PAPER["tables"][table]["rows"]
    return rows[row]["time_ms"] / rows[reference]["time_ms"]


FIGURES = [
    Figure("Points that one round keeps, thousands", "mrv_figures", lambda d: _kept(d, "kept", 1) / 1000, 28),
    Figure("Points that five rounds keep, %", "mrv_figures", lambda d: _kept(d, "percent", 5), 50, above=True),
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
    """A claim about accuracy: what a row gains over its reference."""

    text: str
    row: Row
    reference: Row
    paper: dict[str, float]  # Score -> gain in the paper.


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


def gains_of(claim: Claim, scale: Simulated, cells: Mapping[tuple[str, int], Cell], score: str) -> list[float]:
    """Return a row's gains over its reference in points, one per seed with both cells."""
    names, gains = [changes_of(row.change(scale.base), scale.base) for row in (claim.row, claim.reference)], []
    for seed in sorted({seed for _, seed in cells}):
        own, other = (cells.get((name, seed), {}).get("scores") for name in names)
        if own and other:
            gains.append(100 * (own[score] - other[score]))
    return gains


def figure_lines(results: Path) -> Iterator[str]:
    """Yield a line of Markdown for each claim that needs no training."""
    for figure in FIGURES:
        ours = figure.value(read_json(results / f"{figure.file}.json", dict[str, Any]))
        said = verdict_of_figure(figure, ours)
        paper = f"more than {figure.paper:g}" if figure.above else f"{figure.paper:.3g}"
        source = f"[{figure.file}](results/{figure.file}.json)"
        yield f"| {figure.claim} | {paper} | {ours:.3g} | {source} | {said} |"


def claims() -> Iterator[Claim]:
    """Yield the rows of the paper's tables with a gain in a score, then those with local geometry."""
    for table in TABLES.values():
        for row in table.rows:
            reference, paper = table.reference_of(row), table.paper_difference(row)
            if row is not reference and paper:
                yield Claim(f"{table.name}: {row.label} instead of {reference.label}", row, reference, paper)
    tables = {
        "small": mrv_ablations.SMALL,
        "small, second look": mrv_ablations.SMALL_LOOKED_AGAIN,
        "compact": mrv_ablations.TABLE,
    }
    for sizes, ablations in tables.items():
        rows = {row.label: row for row in ablations.rows}
        for (label, reference), (name, *pair_of_paper) in LOCAL_GEOMETRY.items():
            if label not in rows:
                continue
            theirs, base = (PAPER["tables"][name]["rows"][key] for key in pair_of_paper)
            full = label if reference != "without priority" else "with priority"
            text = f"local geometry, {sizes}: {full} instead of {reference}"
            yield Claim(text, rows[label], rows[reference], {s: round(theirs[s] - base[s], 2) for s in SCORES})


def training_lines(results: Path) -> tuple[list[str], int]:
    """Return a line of Markdown for each claim about accuracy, and the number of claims without scores."""
    scale, lines, missing = quarter(Path("unused")), list[str](), 0
    cells = read_cells(results / "tables" / scale.name, scale)
    for claim in claims():
        gains = {score: gains_of(claim, scale, cells, score) for score in claim.paper}
        if not gains["mAP"]:
            missing += 1
            continue
        samples = scale.train_frames * claim.row.change(scale.base).optimizer.epochs
        columns = [claim.text, f"{len(gains['mAP'])}, {samples:,}"]
        for score, own in gains.items():
            mean, *bounds = interval(own) or (sum(own) / len(own),)
            ours = f"{mean:+.1f}" + (f" [{bounds[0]:+.1f}, {bounds[1]:+.1f}]" if bounds else "")
            paper = claim.paper[score]
            columns += [f"{paper:+.2f}", ours, ": ".join(filter(None, verdict(own, paper)))]
        lines.append(f"| {' | '.join(columns)} |")
    return lines, missing


def _table(columns: str, lines: Iterable[str]) -> str:
    return "\n".join((f"| {columns} |", "|---" * (columns.count("|") + 1) + "|", *lines))


def as_markdown(results: Path) -> str:
    """Format the whole ledger."""
    lines, missing = training_lines(results)
    columns = "gain in points | seeds, samples | mAP, paper | here | verdict | NDS, paper | here | verdict"
    parts = [
        _table("without training | paper | here | from | verdict", figure_lines(results)),
        _table(columns, lines),
        f"{missing} other claims have no scores of both rows for a seed.\n\n{_OUR_NDS}",
    ]
    return "\n\n".join(parts) + "\n"


def with_ledger(document: str, ledger: str) -> str:
    """Replace what is between the two marks of a document by the ledger."""
    before, _, rest = document.partition(_MARKS[0])
    after = rest.partition(_MARKS[1])[2]
    return f"{before}{_MARKS[0]}\n{ledger}\n{_MARKS[1]}{after}"


def main(args: Args) -> None:
    """Print the ledger, and optionally write it."""
    ledger = as_markdown(args.results)
    print(ledger, end="", flush=True)
    if args.write:
        write_text(README, with_ledger(README.read_text(encoding="utf-8"), ledger))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
