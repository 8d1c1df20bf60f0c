"""Table 6: do the levels share their heads?

    python -m experiments.paper_tables.table6_untied_heads --scale sector  # 2 rows, 6 cells

Expected of the paper: a head for every level is worth 0.6 points of mAP.
"""

from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.script import run_script

TABLE = Table(
    "table6",
    "Table 6: heads of the levels",
    (Row("tied", change(model__tied_heads=True), "tied"), Row("untied", change(), "untied")),
    reference="tied",
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
