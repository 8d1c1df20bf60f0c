"""Rounds, sweeps and priority in a detector that has learned.

    python -m experiments.studies.mrv_ablations  # smoke: minutes, a toy
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 1 2
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 1 2 --small  # for CPUs
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 1 2 --small --second-look
    python -m experiments.studies.mrv_ablations --scale sector --seeds 0 --small --second-look --longer

Tables 1, 2 and 7 compare networks of the scale ``sector``, which are small and have no local geometry, after 8,000
samples: their curves end where learning begins. These rows have the local geometry and the sizes of ``compact``,
and see 16,000 samples in batches of four, with a higher learning rate. The first row has five rounds of ten sweeps
with priority. Four rows have fewer rounds, fewer sweeps or no priority, and one row has no local geometry. The
paper's figures for one round, one sweep and no priority are -2.06, -3.66 and -2.79 points of mAP. Round offsets
are the offsets between the points of each pixel's rounds: without them, the heads see the local geometry of the
first round only. With ``--second-look``, the first five rows have the second look of ``compact``, trained
afterwards on the boxes of the frozen detector; it sees the points of all sweeps, also those that no round shows.
With ``--longer``, a table of its own compares the first row with a detector that sees twice as many samples.

Processes with the same folders share the cells; one of them can have ``--simulators 12`` on a machine with many
cores. Cost: on one H100 with 16 cores, 8 minutes for the frames and 3.5 minutes per cell with two processes side
by side; six fit its memory. On a CPU core, several hours per cell; with ``--small``, which keeps the sizes and the
8,000 samples of the scale, one hour; with ``--longer``, twice as long.
"""

import dataclasses
from typing import Any

from experiments.changes import FROZEN_LOOK, LARGER, change
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.script import run_script
from fcos_lidar_jax.config import Config

_GROWN = change(
    **LARGER,
    optimizer__epochs=4,
    optimizer__batch_size=4,
    optimizer__peak_learning_rate=4e-3,
    optimizer__ema_decay=0.992,  # The average over as many samples as with one sample per step and 0.998.
)


@dataclasses.dataclass(frozen=True)
class AblationArgs(Args):
    """Options of the table."""

    small: bool = False  # Keep the sizes, batches and epochs of the scale.
    second_look: bool = False  # Detectors with a second look; without the last two rows.
    longer: bool = False  # Only the first row, and the same after twice as many epochs.


def make_table(*, small: bool, second_look: bool = False, longer: bool = False) -> Table:
    """Create the table; its files are named after the options."""
    refinement = FROZEN_LOOK if second_look else None

    def row(label: str, local_geometry: bool = True, **fields: Any) -> Row:
        own = change(model__local_geometry=local_geometry, refinement=refinement, **fields)

        def apply(config: Config) -> Config:
            return own(_GROWN(config) if config.name == "sector" and not small else config)

        return Row(label, apply)

    rows = (
        row("five rounds of ten sweeps"),
        row("one round of ten sweeps", projection__num_rounds=1),
        row("without priority", projection__prioritize_current=False),
        row("five rounds of one sweep", num_sweeps=1),
        row("one round of one sweep", num_sweeps=1, projection__num_rounds=1),
    )
    if longer:
        first = rows[0]
        rows = (first, Row("twice as long", lambda config: _twice(first.change(config))))
    elif not second_look:
        offsets = row("five rounds of ten sweeps with round offsets", model__round_offsets=True)
        rows = (*rows, offsets, row("without local geometry", local_geometry=False))
    name = "mrv_ablations" + "_small" * small + "_second_look" * second_look + "_longer" * longer
    parts = "local geometry" + " and a second look" * second_look + ", small networks" * small
    title = "A longer training" if longer else "Rounds, sweeps and priority"
    return Table(name, f"{title}, with {parts}", rows, reference=rows[0].label)


def _twice(config: Config) -> Config:
    return change(optimizer__epochs=2 * config.optimizer.epochs)(config)


TABLE, SMALL = make_table(small=False), make_table(small=True)
SMALL_WITH_SECOND_LOOK = make_table(small=True, second_look=True)
LONGER = make_table(small=True, second_look=True, longer=True)


def main(args: AblationArgs) -> None:
    """Train and print the table."""
    run_table(make_table(small=args.small, second_look=args.second_look, longer=args.longer), args)


if __name__ == "__main__":
    run_script(main, AblationArgs, __doc__)
