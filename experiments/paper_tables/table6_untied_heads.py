"""Table 6: do the levels share their heads?

    python -m experiments.paper_tables.table6_untied_heads  # smoke: minutes, a toy
    python -m experiments.paper_tables.table6_untied_heads --scale simulated  # 2 cells, three seeds
    python -m experiments.paper_tables.table6_untied_heads --scale nuscenes --data-root DIR

Expected of the paper: a head for every level is worth 0.6 points of mAP.
"""

from experiments.paper_tables.grid import change
from experiments.paper_tables.tables import Row, Table, command, run_table

TABLE = Table(
    "table6",
    "Table 6: heads of the levels",
    (
        Row("tied", change(model__tied_heads=True), "tied"),
        Row("untied", change(), "untied"),
    ),
    reference="tied",
)


if __name__ == "__main__":
    command(lambda args: run_table(TABLE, args), __doc__)
