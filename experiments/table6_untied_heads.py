"""Table 6: do the levels share their heads?

    python experiments/table6_untied_heads.py                    # smoke: minutes, a toy
    python experiments/table6_untied_heads.py --scale simulated  # 2 cells, three seeds
    python experiments/table6_untied_heads.py --scale nuscenes --data-root DIR

Expected of the paper: a head for every level is worth 0.6 points of mAP.
"""

import tyro
from grid import change
from tables import Args, Row, Table, run_table

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
    run_table(TABLE, tyro.cli(Args, description=__doc__))
