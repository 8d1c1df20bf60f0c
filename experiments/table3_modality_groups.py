"""Table 3: which channels are convolved together.

    python experiments/table3_modality_groups.py                    # smoke: minutes, a toy
    python experiments/table3_modality_groups.py --scale simulated  # 4 cells, three seeds
    python experiments/table3_modality_groups.py --scale nuscenes --data-root DIR

The latency of the module by variant needs no training: ``--only-figures``. Expected of the paper: nine groups beat
one by 0.7 points of mAP at half the time; leaving the rounds ungrouped costs 0.25.
"""

from functools import partial

import module_latency
from grid import change
from tables import Row, Table, command, run_table

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
        module_latency.figures,
        names={
            "one group": "one group",
            "5 modalities": "5 modalities",
            "9 types": "9 types",
            "9 types, rounds apart": "9 types, rounds apart",
        },
    ),
)


if __name__ == "__main__":
    command(lambda args: run_table(TABLE, args), __doc__)
