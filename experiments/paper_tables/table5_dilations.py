"""Table 5: dilation rates of the parallel branches.

    python -m experiments.paper_tables.table5_dilations --scale sector  # 4 rows, 12 cells

Expected of the paper: (1, 3, 6) beats (1,) by 1.2 points of mAP, and three equal branches by 0.45.
"""

from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.script import run_script

TABLE = Table(
    "table5",
    "Table 5: dilations",
    tuple(
        Row(str(dilations), change(model__stem__dilations=dilations), str(dilations))
        for dilations in ((1,), (1, 3), (1, 3, 6), (1, 1, 1))
    ),
    reference="(1,)",
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
