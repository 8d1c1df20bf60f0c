"""Result cells: ``cells.csv`` has one row per training, and ``scale.json`` their common data and base.

A cell is identified by its seed and by its changes to the base configuration, such as
``num_sweeps=1, projection.num_rounds=3``, so that a new configuration field renames no cell. Cells with other data
or another base are refused.
"""

import csv
import dataclasses
import hashlib
import io
import json
import re
from pathlib import Path
from typing import Any

from flax.traverse_util import flatten_dict, unflatten_dict

from experiments.paper_tables.scales import Scale
from experiments.script import compact_json
from fcos_lidar_jax.checkpoints.storage import LATER_FIELDS
from fcos_lidar_jax.config import Config, RefinementConfig, config_to_json
from fcos_lidar_jax.files import atomic_write, file_lock, read_json

Cell = dict[str, Any]  # ``changes``, ``seed``, ``scores`` or ``diverged``, and hardware.
_CELLS, _SCALE, _LOCK = "cells.csv", "scale.json", "cells.lock"
_TEXT = {"changes", "diverged", "git", "device", "processor", "jax", "python", "fcos_lidar_jax"}
_MAX_NAME = 80  # Characters of a folder's name.


def changes_of(config: Config, base: Config) -> str:
    """Describe the differences between a configuration and its base, except the name.

    >>> from experiments.changes import change
    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> changes_of(change(projection__num_rounds=3, num_sweeps=2, name="other")(QUICKSTART), QUICKSTART)
    'num_sweeps=2, projection.num_rounds=3'
    >>> changes_of(QUICKSTART, QUICKSTART)
    'base'
    >>> from fcos_lidar_jax.config import RefinementConfig
    >>> changes_of(change(refinement=RefinementConfig(num_boxes=64))(QUICKSTART), QUICKSTART)
    'refinement="on", refinement.num_boxes=64'
    """
    added = {}
    if config.refinement is not None and base.refinement is None:
        added, base = {"refinement": "on"}, dataclasses.replace(base, refinement=RefinementConfig())
    own, before = (_flat(config_to_json(c)) for c in (config, base))
    differing = added | {
        field: own[field] for field in own.keys() - {"name"} if before.get(field, ...) != own[field]
    }
    return ", ".join(f"{field}={json.dumps(differing[field])}" for field in sorted(differing)) or "base"


def run_name(changes: str, seed: int) -> str:
    """Name the folder of a cell's training.

    >>> run_name("num_sweeps=1, projection.num_rounds=3", 0)
    'num_sweeps=1_projection.num_rounds=3_seed=0'
    """
    name = re.sub(r"[^\w.=-]+", "_", changes)
    if len(name) > _MAX_NAME:
        name = f"{name[:_MAX_NAME]}_{hashlib.blake2b(changes.encode(), digest_size=4).hexdigest()}"
    return f"{name}_seed={seed}"


def read_cells(folder: Path, scale: Scale) -> dict[tuple[str, int], Cell]:
    """Read the finished cells of a scale, by changes and seed; cells of other data or another base are refused."""
    if not (folder / _CELLS).is_file():
        return {}
    _check(folder / _SCALE, _shared(scale))
    with (folder / _CELLS).open(encoding="utf-8", newline="") as file:
        cells = [_cell(row) for row in csv.DictReader(file)]
    return {(cell["changes"], cell["seed"]): cell for cell in cells}


def add_cell(folder: Path, scale: Scale, cell: Cell, *, locks: Path) -> Cell:
    """Add a finished cell to its scale's file."""
    with file_lock(locks / _LOCK, wait=True):
        cells = read_cells(folder, scale) | {(cell["changes"], cell["seed"]): cell}
        rows = [_row(cells[key]) for key in sorted(cells)]
        text = io.StringIO()
        columns = list(dict.fromkeys(name for row in rows for name in row))
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        if not (folder / _SCALE).is_file():
            atomic_write(folder / _SCALE, compact_json(_shared(scale)) + "\n")
        atomic_write(folder / _CELLS, text.getvalue())
    return read_cells(folder, scale)[cell["changes"], cell["seed"]]


def _row(cell: Cell) -> dict[str, str]:
    flat: dict[str, Any] = flatten_dict(cell, sep=".", is_leaf=lambda _, value: not value)
    return {name: value if name in _TEXT else json.dumps(value) for name, value in flat.items()}


def _cell(row: dict[str, str]) -> Cell:
    flat = {name: text if name in _TEXT else json.loads(text) for name, text in row.items() if text}
    return unflatten_dict(flat, sep=".")


def _shared(scale: Scale) -> dict[str, Any]:
    return {"data": scale.describe(), "base": config_to_json(scale.base)}


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    return flatten_dict(json.loads(json.dumps(record)), sep=".")


def _check(file: Path, shared: dict[str, Any]) -> None:
    """Compare data and base of the cells with the scale's; fields that the file lacks have later defaults."""
    recorded = _flat({"base": LATER_FIELDS}) | _flat(read_json(file, dict[str, Any]))
    for field, value in _flat(shared).items():
        if field != "base.name" and recorded.get(field, value) != value:
            line = f"{file}: {field}: got {recorded[field]!r}, expected {value!r}"
            raise ValueError(f"{line}: its cells are of another scale, choose another --out and --runs")
