"""Table 7: where the time goes from raw sweeps to boxes, one sweep and ten, batch 1.

    python -m experiments.paper_tables.table7_latency --scale sector  # 2 rows, 6 cells

The times are the paper's preset's, need no training (``--only-figures``) and are those of ``latency.py``, which
says how the stages are cut.
The paper's are of a 3090Ti: on other hardware only the shares compare. Expected of the paper: the projection is a
fiftieth of the time, and ten sweeps cost no more than one.
"""

from typing import Any

from experiments.benchmarks import latency
from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.script import run_script


def figures(args: Args) -> dict[str, Any]:
    """Times of the stages."""
    preset, repeats = ("quickstart", 3) if args.scale == "smoke" else ("nuscenes", 15)
    options = latency.Args(preset=preset, precision=args.nuscenes.precision, data=args.data, repeats=repeats)
    measured = latency.measure(options)
    columns = {
        f"{setting}-frame": {f"{stage}, ms": times["median_ms"] for stage, times in of_setting.items()}
        for setting, of_setting in measured["times"].items()
    }
    return {"columns": columns, "lines": ["```", latency.as_text(measured), "```"]}


TABLE = Table(
    "table7",
    "Table 7: one sweep and ten",
    (
        Row("single-frame", change(num_sweeps=1), "FCOS-LiDAR, single"),
        Row("multi-frame", change(), "FCOS-LiDAR, multi"),
    ),
    reference="single-frame",
    figures=figures,
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
