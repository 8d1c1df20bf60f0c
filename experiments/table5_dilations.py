"""Table 5: dilation rates of the parallel branches.

    python experiments/table5_dilations.py                    # smoke: minutes, a toy
    python experiments/table5_dilations.py --scale simulated  # 4 cells, three seeds
    python experiments/table5_dilations.py --scale nuscenes --data-root DIR

Expected of the paper: (1, 3, 6) beats (1,) by 1.2 points of mAP, and three equal branches by 0.45.
"""

from grid import change
from tables import Row, Table, command, run_table

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
    command(lambda args: run_table(TABLE, args), __doc__)
