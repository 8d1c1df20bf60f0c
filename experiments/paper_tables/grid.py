"""A grid of configurations, trained and scored: what the paper's tables are made of.

A cell is a configuration, a scale and a seed. Its result is one JSON file, named as ``cell_names.py`` says, so
that a finished cell is never run again, a cell that several tables share is run once, a stopped one resumed.
Processes that share the folders, one a GPU or a core, share the cells. The code's revision is no part of the name;
it stands in the file.
"""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.hardware import hardware
from experiments.paper_tables.cell_names import cell_name
from experiments.paper_tables.scales import Scale
from fcos_lidar_jax.checkpoints.storage import NonFiniteStateError
from fcos_lidar_jax.config import Config, config_to_json
from fcos_lidar_jax.files import atomic_write, file_lock
from fcos_lidar_jax.training import NonFiniteLossError

_PATIENCE_S = 5.0  # Between looks at what other processes train.


def run_cells(
    cells: Sequence[tuple[Config, int]], scale: Scale, *, results: Path, runs: Path, labels: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """The records of configurations with seeds, in their order, each from its file or by training it.

    A label is printed when its cell's training begins. A cell that another process trains is left to it and
    looked at again when the others are done.
    """
    found: dict[int, dict[str, Any]] = {}
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
) -> dict[str, Any] | None:
    """What a cell's file holds, trained if need be, and its ``name``; None while another process trains it.

    A run whose loss or state stopped being finite is a result too: ``diverged`` in place of ``scores``, and what
    was said. ``git`` names the revisions of all processes that took part, in their order.
    """
    name = cell_name(config, scale.describe(), seed)
    file = results / f"{name}.json"
    with file_lock(runs / f"{name}.lock") as mine:
        if file.is_file():
            return {"name": name, **json.loads(file.read_text(encoding="utf-8"))}
        if not mine:
            return None
        if title:
            print(title, file=sys.stderr, flush=True)
        revisions = _join(runs / name, hardware()["git"])
        try:
            outcome: dict[str, Any] = {"scores": scale.score(config, seed, runs / name)}
        except (NonFiniteLossError, NonFiniteStateError) as error:
            outcome = {"diverged": str(error)}
        record = {**outcome, "seed": seed, "scale": scale.describe(), "config": config_to_json(config)}
        record |= {**hardware(), "git": ", then ".join(revisions)}
        text = json.dumps(record, indent=1)
        atomic_write(file, lambda path: path.write_text(text, encoding="utf-8"))
        return {"name": name, **json.loads(text)}


def _join(folder: Path, revision: str) -> list[str]:
    """Record in a run's folder the revision that works on it now; all that did."""
    file = folder / "revisions.txt"
    before = file.read_text(encoding="utf-8").split() if file.is_file() else []
    revisions = before if before[-1:] == [revision] else [*before, revision]
    atomic_write(file, lambda path: path.write_text("\n".join(revisions), encoding="utf-8"))
    return revisions
