"""Table 3: which channels are convolved together.

    python -m experiments.paper_tables.table3_modality_groups  # smoke: minutes, a toy
    python -m experiments.paper_tables.table3_modality_groups --scale simulated  # 4 cells, three seeds
    python -m experiments.paper_tables.table3_modality_groups --scale nuscenes --data-root DIR

The latency of the module by variant needs no training: ``--only-figures``. Expected of the paper: nine groups beat
one by 0.7 points of mAP at half the time; leaving the rounds ungrouped costs 0.25.
"""

from functools import partial

from experiments.paper_tables.grid import change
from experiments.paper_tables.tables import Row, Table, command, run_table, stem_times

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
    figures=partial(
        stem_times, {name: name for name in ("one group", "5 modalities", "9 types", "9 types, rounds apart")}
    ),
)


if __name__ == "__main__":
    command(lambda args: run_table(TABLE, args), __doc__)
