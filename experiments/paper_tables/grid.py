"""A grid of configurations, trained and scored: what the paper's tables are made of.

A cell is a configuration, a scale and a seed. Its result is a row of the scale's file (``cells.py``), so that a
finished cell is never run again, a cell that several tables share is run once, a stopped one resumed. Processes
that share the folders, one per GPU or core, share the cells. The code's revision does not name a cell; its row has
it.
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

_PATIENCE_S = 5.0  # Between looks at what other processes train.


def run_cells(
    cells: Sequence[tuple[Config, int]], scale: Scale, *, results: Path, runs: Path, labels: Sequence[str] = ()
) -> list[Cell]:
    """The records of configurations with seeds, in their order, each from the file or by training it.

    A label is printed when its cell's training begins. A cell that another process trains is left to it and
    looked at again when the others are done.
    """
    found: dict[int, Cell] = {}
    while len(found) < len(cells):
        known = len(found)
        for i, (config, seed) in enumerate(cells):
            title = f"cell {i + 1} of {len(cells)}: {labels[i]}" if labels else ""
            record = None
            if i not in found:
                record = run_cell(config, scale, seed, results=results, runs=runs, title=title)
            if record is not None:
                found[i] = record
        if len(found) == known:
            time.sleep(_PATIENCE_S)
    return [found[i] for i in range(len(cells))]


def run_cell(
    config: Config, scale: Scale, seed: int, *, results: Path, runs: Path, title: str = ""
) -> Cell | None:
    """A cell of the folder ``results``, trained if need be; None while another process trains it.

    A run whose loss or state stopped being finite is a result too: ``diverged`` in place of ``scores``, and what
    was said. ``git`` names the revisions of all processes that took part, in their order.
    """
    changes = changes_of(config, scale.base)
    name = run_name(changes, seed)
    with file_lock(runs / f"{name}.lock") as mine:
        if known := read_cells(results, scale).get((changes, seed)):
            return known
        if not mine:
            return None
        if title:
            print(title, file=sys.stderr, flush=True)
        revisions = _join(runs / name, hardware()["git"])
        try:
            outcome: Cell = {"scores": scale.score(config, seed, runs / name)}
        except (NonFiniteLossError, NonFiniteStateError) as error:
            outcome = {"diverged": str(error)}
        cell = {"changes": changes, "seed": seed, **outcome, **hardware(), "git": ", then ".join(revisions)}
        return add_cell(results, scale, cell, locks=runs)


def _join(folder: Path, revision: str) -> list[str]:
    """Record in a run's folder the revision that works on it now; all that did."""
    file = folder / "revisions.txt"
    before = file.read_text(encoding="utf-8").split() if file.is_file() else []
    revisions = before if before[-1:] == [revision] else [*before, revision]
    atomic_write(file, lambda path: path.write_text("\n".join(revisions), encoding="utf-8"))
    return revisions
