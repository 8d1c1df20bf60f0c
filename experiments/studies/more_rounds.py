"""What do five rounds need to be worth more than one? Traffic and length of the training, of table 1's rows.

    python -m experiments.studies.more_rounds  # smoke: minutes, a toy
    python -m experiments.studies.more_rounds --scale simulated  # 5 cells, two of them three times as long

In fast traffic and after two epochs, five rounds of ten sweeps score less than one (table 1 at scale simulated),
where the paper gains 2.1 points. The first table has light traffic, the second three times the epochs. Expected of
the paper: five rounds win in both. The result is in README.md.
"""

import dataclasses

from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table
from experiments.script import run_script
from fcos_lidar_jax.config import Config

_LONGER = 3  # Times the epochs of the scale.


def _longer(rounds: int) -> Row:
    def apply(config: Config) -> Config:
        epochs = _LONGER * config.optimizer.epochs
        return change(optimizer__epochs=epochs, projection__num_rounds=rounds)(config)

    label = f"{rounds} round" + ("s" if rounds > 1 else "")
    return Row(f"{label}, {_LONGER} x epochs", apply, reference=f"1 round, {_LONGER} x epochs")


_ONE = Row("1 round", change(projection__num_rounds=1))
_FIVE = Row("5 rounds", change(projection__num_rounds=5))
_MIXED = Row("5 rounds, no priority", change(projection__prioritize_current=False), reference="5 rounds")
TRAFFIC = Table("rounds_and_traffic", "Rounds and traffic", (_ONE, _FIVE, _MIXED), reference="1 round")
_ROWS = (_ONE, _FIVE, _longer(1), _longer(5))
LENGTH = Table("rounds_and_length", "Rounds and length of the training", _ROWS, reference="1 round")


def main(args: Args) -> None:
    """Both tables."""
    if args.scale not in ("smoke", "simulated"):
        raise ValueError(f"--scale: got {args.scale}, expected smoke or simulated")
    run_table(TRAFFIC, dataclasses.replace(args, scale="calm") if args.scale == "simulated" else args)
    run_table(LENGTH, args)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
