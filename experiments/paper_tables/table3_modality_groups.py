"""Table 3: which channels are convolved together.

    python -m experiments.paper_tables.table3_modality_groups --scale sector  # 4 rows, 12 cells

The latency of the module by variant needs no training: ``--only-figures``. Expected of the paper: nine groups beat
one by 0.7 points of mAP at half the time; leaving the rounds ungrouped costs 0.25.
"""

from functools import partial

from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table, stem_times
from experiments.script import run_script

_VARIANTS = {name: name for name in ("one group", "5 modalities", "9 types", "9 types, rounds apart")}
TABLE = Table(
    "table3",
    "Table 3: modality-wise convolutions",
    (
        Row("one group", change(model__stem__groups="all"), "1 group"),
        Row("5 modalities", change(model__stem__groups="modalities"), "5 groups"),
        Row("9 types", change(), "9 groups"),
        Row("9 types, rounds apart", change(model__stem__group_rounds=False), "9 groups, rounds not grouped"),
    ),
    reference="one group",
    figures=partial(stem_times, _VARIANTS),
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
