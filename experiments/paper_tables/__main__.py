"""Train and measure the tables of the paper.

    python -m experiments.paper_tables --scale smoke  # all tables on a toy
    python -m experiments.paper_tables --tables table1 table6 --scale sector
    python -m experiments.paper_tables --tables table8 --scale nuscenes --data-root DIR --test-version V

Each table prints our figures next to the paper's and writes Markdown, JSON and pictures below ``--out``.
``experiments/README.md`` explains the scales, their cost, and how several processes share the cells. Measure times
on an idle machine: once all cells are trained, the same command only measures again.
"""

import dataclasses

from experiments.paper_tables import submission
from experiments.paper_tables.paper_rows import PAPER_TABLES
from experiments.paper_tables.tables import Args, run_table
from experiments.script import run_script

TABLES = {table.name: table for table in (*PAPER_TABLES, submission.TABLE)}


@dataclasses.dataclass(frozen=True)
class TablesArgs(Args):
    """Options of the tables."""

    tables: tuple[str, ...] = ()  # Tables to train, such as table1; default: all.


def main(args: TablesArgs) -> None:
    """Run the tables one after the other."""
    if unknown := [name for name in args.tables if name not in TABLES]:
        raise ValueError(f"--tables: got {unknown[0]!r}, expected some of {', '.join(TABLES)}")
    if args.rows and len(args.tables) != 1:
        raise ValueError(f"--rows: got {list(args.rows)}, expected none unless --tables names one table")
    for name in args.tables or TABLES:
        run_table(TABLES[name], args)


if __name__ == "__main__":
    run_script(main, TablesArgs, __doc__)
