"""A grid of configurations, trained and scored: what the paper's tables are made of.

A cell is a configuration, a scale and a seed. Its result is one JSON file named by their hash, so that a finished
cell is never run again, a cell that several tables share is run once, and a stopped one goes on where it was.
"""

import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hardware import hardware
from scales import Scale

from fcos_lidar_jax.config import Config, config_to_json
from fcos_lidar_jax.files import write_beside


def cell_name(config: Config, scale: Scale, seed: int) -> str:
    """Hash of all that decides a cell's result; not of names, nor of how the same function is computed.

    >>> from scales import smoke
    >>> scale = smoke(Path("cache"))
    >>> other = dataclasses.replace(scale.base, name="another name")
    >>> cell_name(scale.base, scale, 0) == cell_name(other, scale, 0) != cell_name(scale.base, scale, 1)
    True
    """
    stem = dataclasses.replace(config.model.stem, form="split")
    config = dataclasses.replace(config, name="", model=dataclasses.replace(config.model, stem=stem))
    text = json.dumps([config_to_json(config), scale.describe(), seed], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def run_cell(config: Config, scale: Scale, seed: int, *, results: Path, runs: Path) -> dict[str, Any]:
    """The scores of a cell, from its file or by training it.

    Args:
        config: of the row.
        scale: where and how long.
        seed: of weights, order and augmentation.
        results: folder of the cells' files.
        runs: folder of the training runs.
    """
    name = cell_name(config, scale, seed)
    file = results / f"{name}.json"
    if file.is_file():
        return json.loads(file.read_text(encoding="utf-8"))["scores"]
    began = time.monotonic()
    scores = scale.score(config, seed, runs / name)
    record = {
        "scores": scores,
        "seed": seed,
        "scale": scale.describe(),
        "config": config_to_json(config),
        "minutes": round((time.monotonic() - began) / 60, 2),
        **hardware(),
    }
    text = json.dumps(record, indent=1)
    write_beside(file, lambda path: path.write_text(text, encoding="utf-8"))
    return scores


def interval(values: Sequence[float]) -> tuple[float, float, float] | None:
    """Mean and 95 % interval of Student's t over seeds; None for fewer than two.

    >>> [round(v, 3) for v in interval([1.0, 2.0, 3.0])]
    [2.0, -0.484, 4.484]
    """
    from scipy.stats import t

    if len(values) < 2:
        return None
    mean, error = float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))
    half = float(t.ppf(0.975, len(values) - 1)) * error
    return mean, mean - half, mean + half


Change = Callable[[Config], Config]
"""A row of a table as a change of the base."""


def change(**fields: Any) -> Change:
    """Replace fields of a configuration; dots are double underscores.

    >>> from fcos_lidar_jax.config import QUICKSTART
    >>> change(projection__num_rounds=3, num_sweeps=1)(QUICKSTART).projection.num_rounds
    3
    """

    def apply(config: Config) -> Config:
        return functools.reduce(lambda c, item: _replaced(c, item[0].split("__"), item[1]), fields.items(), config)

    return apply


def _replaced(config: Any, path: list[str], value: Any) -> Any:
    first, *rest = path
    return dataclasses.replace(
        config, **{first: _replaced(getattr(config, first), rest, value) if rest else value}
    )
