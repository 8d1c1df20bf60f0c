"""Rounds, sweeps and priority with local geometry, after a chosen number of samples.

    python -m experiments.studies.mrv_ablations  # smoke: minutes, a toy
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 1 2 3 4 --epochs 4

The cells of tables 1, 2 and 7 are of a network that learns slowly, because the scale ``sector`` has no local
geometry, unlike ``compact``. These rows have it, and each takes one part away from five rounds of ten sweeps with
priority. The paper's figures for the same changes are -2.06 (one round), -3.66 (one sweep) and -2.79 (without
priority) points of mAP. The heads see the local geometry of the first round only. An epoch of ``sector`` has 4,000
samples. Cost: ``experiments/README.md`` estimates the hours. Only the cell of one round with seed 0 has been
trained.
"""

import dataclasses
from typing import Any

from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.script import run_script

_ROWS: dict[str, dict[str, Any]] = {
    "five rounds of ten sweeps": {},
    "one round": {"projection__num_rounds": 1},
    "one sweep": {"num_sweeps": 1},
    "without priority": {"projection__prioritize_current": False},
}


@dataclasses.dataclass(frozen=True)
class AblationArgs(Args):
    """Options of the table."""

    epochs: int | None = None  # Passes over the training frames; default: the scale's.


def make_table(epochs: int | None = None) -> Table:
    """Create the table; its files are named after the epochs."""
    shared: dict[str, Any] = {"model__local_geometry": True}
    name, title = "mrv_ablations", "Rounds, sweeps and priority, with local geometry"
    if epochs is not None:
        shared |= {"optimizer__epochs": epochs}
        name, title = f"{name}_{epochs}_epochs", f"{title}, {epochs} epochs"
    rows = tuple(Row(label, change(**shared, **own)) for label, own in _ROWS.items())
    return Table(name, title, rows, reference=rows[0].label)


TABLE = make_table()


def main(args: AblationArgs) -> None:
    """Train and print the table."""
    if args.scale == "nuscenes":
        raise ValueError("--scale: got nuscenes, expected smoke or sector")
    if args.epochs is not None and args.epochs < 1:
        raise ValueError(f"--epochs: got {args.epochs}, expected at least 1")
    run_table(make_table(args.epochs), args)


if __name__ == "__main__":
    run_script(main, AblationArgs, __doc__)
