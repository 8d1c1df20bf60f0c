"""Table 6: do the levels share their heads?

    python experiments/table6_untied_heads.py                    # smoke: minutes, a toy
    python experiments/table6_untied_heads.py --scale simulated  # 2 cells, three seeds
    python experiments/table6_untied_heads.py --scale nuscenes --data-root DIR

Expected of the paper: a head for every level is worth 0.6 points of mAP.
"""

from grid import change
from tables import Row, Table, command, run_table

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
