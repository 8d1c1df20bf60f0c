"""Table 4: grouped convolutions a branch.

    python -m experiments.paper_tables.table4_num_convs --scale sector  # 3 rows, 9 cells

The latency of the module by variant needs no training: ``--only-figures``. Expected of the paper: two beat one by
1.3 points of mAP, a third does not help.
"""

from functools import partial

from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table, stem_times
from experiments.script import run_script

TABLE = Table(
    "table4",
    "Table 4: layers of modality-wise convolutions",
    tuple(Row(f"{n}", change(model__stem__num_convs=n), str(n)) for n in (1, 2, 3)),
    reference="1",
    figures=partial(stem_times, {"1": "1 convolution", "2": "9 types", "3": "3 convolutions"}),
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
