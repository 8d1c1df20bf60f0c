"""Table 2: do the points of the current sweep win every collision?

    python experiments/table2_priority.py                    # smoke: minutes, a toy
    python experiments/table2_priority.py --scale simulated  # 2 cells, three seeds
    python experiments/table2_priority.py --scale nuscenes --data-root DIR

Expected of the paper: without priority ten sweeps lose 2.8 points of mAP.
"""

import tyro
from grid import change
from tables import Args, Row, Table, run_table

TABLE = Table(
    "table2",
    "Table 2: priority of the current sweep",
    (
        Row("without priority", change(projection__prioritize_current=False), "not prioritized"),
        Row("with priority", change(), "prioritized"),
    ),
    reference="without priority",
)


if __name__ == "__main__":
    run_table(TABLE, tyro.cli(Args, description=__doc__))
