"""All tables of the paper, one after the other: ``python -m experiments.paper_tables --scale smoke``.

Every table prints our figure beside the paper's, and writes Markdown, JSON and a picture below ``--out``.
README.md says what the scales cost, and how several processes share the cells. Times want a machine that does
nothing else: once all cells are there, the command again measures them anew.
"""

from experiments.paper_tables.table1_mrv_rounds import TABLE as TABLE_1
from experiments.paper_tables.table2_priority import TABLE as TABLE_2
from experiments.paper_tables.table3_modality_groups import TABLE as TABLE_3
from experiments.paper_tables.table4_num_convs import TABLE as TABLE_4
from experiments.paper_tables.table5_dilations import TABLE as TABLE_5
from experiments.paper_tables.table6_untied_heads import TABLE as TABLE_6
from experiments.paper_tables.table7_latency import TABLE as TABLE_7
from experiments.paper_tables.table8_test_submission import TABLE as TABLE_8
from experiments.paper_tables.tables import Args, run_table
from experiments.script import run_script

TABLES = (TABLE_1, TABLE_2, TABLE_3, TABLE_4, TABLE_5, TABLE_6, TABLE_7, TABLE_8)


def main(args: Args) -> None:
    """All tables, with all of their rows."""
    if args.rows:
        raise ValueError(f"--rows: got {list(args.rows)}, expected none: a table's own script takes them")
    for table in TABLES:
        run_table(table, args)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
