"""Training and scoring of cells, which the paper's tables consist of.

A cell is a configuration, a scale and a seed. Its result is a row of the scale's file (``cells.py``), so a
finished cell is never trained again, tables share cells, and an interrupted cell is resumed. Processes with the
same folders, one per GPU or core, share the cells. The revision of the code is recorded but does not identify a
cell.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.hardware import hardware
from experiments.paper_tables.cells import Cell, add_cell, changes_of, read_cells, run_name
from experiments.paper_tables.scales import Scale
from fcos_lidar_jax.checkpoints.storage import NonFiniteStateError
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.files import atomic_write, file_lock
from fcos_lidar_jax.training import NonFiniteLossError

_POLL_S = 5.0  # Interval of looking for the results of other processes, seconds.


def run_cells(
    cells: Sequence[tuple[Config, int]], scale: Scale, *, results: Path, runs: Path, labels: Sequence[str] = ()
) -> list[Cell]:
    """Return the records of cells in the given order, from the file or by training.

    A label is printed when the training of its cell begins. Cells that other processes train are left to them and
    read when all others are done.
    """
    records: dict[int, Cell] = {}
    while len(records) < len(cells):
        before = len(records)
        for i, (config, seed) in enumerate(cells):
            if i not in records:
                title = f"cell {i + 1} of {len(cells)}: {labels[i]}" if labels else ""
                if cell := run_cell(config, scale, seed, results=results, runs=runs, title=title):
                    records[i] = cell
        if len(records) == before:
            time.sleep(_POLL_S)
    return [records[i] for i in range(len(cells))]


def run_cell(
    config: Config, scale: Scale, seed: int, *, results: Path, runs: Path, title: str = ""
) -> Cell | None:
    """Return a cell of the folder ``results``, trained if necessary; None while another process trains it.

    A loss or state that is not finite is a result too: ``diverged`` replaces ``scores`` and contains the error.
    ``git`` lists the revisions of all processes that trained it.
    """
    changes = changes_of(config, scale.base)
    name = run_name(changes, seed)
    with file_lock(runs / f"{name}.lock") as held:
        if known := read_cells(results, scale).get((changes, seed)):
            return known
        if not held:
            return None
        if title:
            print(title, file=sys.stderr, flush=True)
        revisions = _add_revision(runs / name, hardware()["git"])
        try:
            outcome: Cell = {"scores": scale.score(config, seed, runs / name)}
        except (NonFiniteLossError, NonFiniteStateError) as error:
            outcome = {"diverged": str(error)}
        cell = {"changes": changes, "seed": seed, **outcome, **hardware(), "git": ", then ".join(revisions)}
        return add_cell(results, scale, cell, locks=runs)


def _add_revision(folder: Path, revision: str) -> list[str]:
    """Record the current revision in a run's folder; returns all recorded revisions."""
    file = folder / "revisions.txt"
    before = file.read_text(encoding="utf-8").split() if file.is_file() else []
    revisions = before if before[-1:] == [revision] else [*before, revision]
    atomic_write(file, "\n".join(revisions))
    return revisions
