"""Table 1: rounds of the multi-round projection, one sweep and ten.

    python -m experiments.paper_tables.table1_mrv_rounds  # smoke: minutes, a toy
    python -m experiments.paper_tables.table1_mrv_rounds --scale simulated  # 8 cells, three seeds
    python -m experiments.paper_tables.table1_mrv_rounds --scale nuscenes --data-root DIR

The points that 1, 3, 5 and 7 rounds keep, of a real cloud and of the scale's own, and the time of the projection
need no training: ``--only-figures``.
Expected of the paper: with ten sweeps five rounds are worth 2.1 points of mAP over one; with one sweep three are
worth 0.6, five 0.3; the time hardly grows.
"""

from typing import Any

from experiments.benchmarks import mrv_figures
from experiments.paper_tables.grid import change
from experiments.paper_tables.tables import Args, Row, Table, command, run_table, simulated_scale


def figures(args: Args) -> dict[str, Any]:
    """What the rounds keep, and their time."""
    repeats = 10 if args.scale == "smoke" else 100
    measured = mrv_figures.measure(mrv_figures.Args(data=args.data, repeats=repeats))
    kept = {"single": "one sweep, without close points", "multi": "ten sweeps, without close points"}
    columns = {
        label(setting, rounds): {
            "points kept, %": measured["kept"][kept[setting]]["prioritized"]["percent"][str(rounds)],
            "MRV, ms": measured["times"][setting][str(rounds)]["median_ms"],
        }
        for setting in SETTINGS
        for rounds in mrv_figures.ROUNDS
    }
    for rounds in mrv_figures.ROUNDS:  # the paper's are read as those of ten sweeps
        columns[label("multi", rounds)]["MRV, ms, paper"] = measured["paper_times"][str(rounds)]["median_ms"]
    scale = simulated_scale(args)
    if scale is not None:
        for setting, sweeps in SETTINGS.items():
            mean = mrv_figures.mean_kept(scale.clouds(sweeps), scale.sensor)["prioritized"]["percent"]
            for rounds in mrv_figures.ROUNDS:
                columns[label(setting, rounds)]["points kept, %, this scale"] = mean[str(rounds)]
    return {"columns": columns, "lines": ["```", mrv_figures.as_text(measured), "```"], "measured": measured}


def label(setting: str, rounds: int) -> str:
    """Name of a row."""
    return f"{setting}, {rounds} round" + ("s" if rounds > 1 else "")


SETTINGS = {"single": 1, "multi": 10}
"""Sweeps fused."""
TABLE = Table(
    "table1",
    "Table 1: multi-round projection",
    tuple(
        Row(
            label(setting, rounds),
            change(num_sweeps=sweeps, projection__num_rounds=rounds),
            f"{setting}, {rounds}",
            reference=label(setting, 1),
        )
        for setting, sweeps in SETTINGS.items()
        for rounds in mrv_figures.ROUNDS
    ),
    reference="multi, 1 round",
    figures=figures,
)


if __name__ == "__main__":
    command(lambda args: run_table(TABLE, args), __doc__)
