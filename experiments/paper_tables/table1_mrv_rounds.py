"""Table 1: rounds of the multi-round projection, one sweep and ten.

    python -m experiments.paper_tables.table1_mrv_rounds --scale sector  # 8 rows, 24 cells

The points that 1, 3, 5 and 7 rounds keep, of a real cloud and of the scale's own, and the time of the projection
need no training: ``--only-figures``.
Expected of the paper: with ten sweeps five rounds are worth 2.1 points of mAP over one; with one sweep three are
worth 0.6, five 0.3; the time hardly grows.
"""

from typing import Any

from experiments.benchmarks import mrv_figures
from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table, simulated_scale
from experiments.script import run_script


def figures(args: Args) -> dict[str, Any]:
    """What the rounds keep, and their time."""
    repeats = 10 if args.scale == "smoke" else 100
    measured = mrv_figures.measure(mrv_figures.Args(data=args.data, repeats=repeats))
    scale, columns = simulated_scale(args), {}
    for setting, sweeps in SETTINGS.items():
        kept = measured["kept"][f"{'ten sweeps' if sweeps > 1 else 'one sweep'}, without close points"]
        here = mrv_figures.mean_kept(scale.clouds(sweeps), scale.sensor) if scale else None
        for rounds in mrv_figures.ROUNDS:
            r, column = str(rounds), columns.setdefault(_label(setting, rounds), {})
            column["points kept, %"] = kept["prioritized"]["percent"][r]
            column["MRV, ms"] = measured["times"][setting][r]["median_ms"]
            if setting == "multi":  # as which the paper's are read
                column["MRV, ms, paper"] = measured["paper_times"][r]["median_ms"]
            if here:
                column["points kept, %, this scale"] = here["prioritized"]["percent"][r]
    return {"columns": columns, "lines": ["```", mrv_figures.as_text(measured), "```"]}


def _label(setting: str, rounds: int) -> str:
    return f"{setting}, {rounds} round" + ("s" if rounds > 1 else "")


SETTINGS = {"single": 1, "multi": 10}  # Sweeps fused.
TABLE = Table(
    "table1",
    "Table 1: multi-round projection",
    tuple(
        Row(
            _label(setting, rounds),
            change(num_sweeps=sweeps, projection__num_rounds=rounds),
            f"{setting}, {rounds}",
            reference=_label(setting, 1),
        )
        for setting, sweeps in SETTINGS.items()
        for rounds in mrv_figures.ROUNDS
    ),
    reference="multi, 1 round",
    figures=figures,
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
