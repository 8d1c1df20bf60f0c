"""Table 2: do the points of the current sweep win every collision?

    python -m experiments.paper_tables.table2_priority --scale sector  # 2 rows, 6 cells

How many points of the current sweep are kept, of the scale's simulated clouds, needs no training:
``--only-figures``. Expected of the paper: without priority ten sweeps lose 2.8 points of mAP.
"""

from typing import Any

from experiments.benchmarks import mrv_figures
from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table, simulated_scale
from experiments.script import run_script


def figures(args: Args) -> dict[str, Any]:
    """Points of the current sweep that are kept."""
    scale = simulated_scale(args)
    if scale is None:
        return {}
    mean = mrv_figures.mean_kept(scale.clouds(scale.base.num_sweeps), scale.sensor)
    rows = {"without priority": "not prioritized", "with priority": "prioritized"}
    current = {row: mean[name]["current"][str(scale.base.projection.num_rounds)] for row, name in rows.items()}
    return {"columns": {row: {"current points kept, this scale": number} for row, number in current.items()}}


TABLE = Table(
    "table2",
    "Table 2: priority of the current sweep",
    (
        Row("without priority", change(projection__prioritize_current=False), "not prioritized"),
        Row("with priority", change(), "prioritized"),
    ),
    reference="without priority",
    figures=figures,
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
