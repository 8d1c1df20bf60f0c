"""What objects of the ten classes look like: models from ``objects.toml``, and the solids that they consist of."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, WHEEL, make_solids

_MARGIN_M = 0.04  # an annotated box stands off from the solids by this on every side, as hand-drawn boxes do
_KINDS = {"box": BOX, "drum": DRUM, "ball": BALL, "wheel": WHEEL}
_MATERIALS = {  # albedo (None: the object's own paint) and density
    "paint": (None, np.inf),
    "glass": (0.03, 0.5),
    "rubber": (0.03, np.inf),
    "steel": (0.12, np.inf),
    "plate": (0.4, np.inf),
    "cloth": (None, np.inf),
    "skin": (0.25, np.inf),
    "dirt": (0.15, np.inf),
    "screen": (0.08, 40.0),
}


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectModel:
    """One model of a class; ``objects.toml`` explains the fields."""

    category: str  # nuScenes category
    size_m: list[float]
    spread: list[float]
    share: float
    solids: np.ndarray  # [s], in fractions of the box
    painted: np.ndarray  # bool[s]: which of them bear the object's own colour
    speed_mps: tuple[float, float] = (0.0, 0.0)
    paint: tuple[float, float] = (0.1, 0.7)
    rider: bool = False


def _make_model(parts: list[dict[str, Any]], **fields: Any) -> ObjectModel:
    solids, painted = [], []
    for part in parts:
        kind = next(name for name in _KINDS if name in part)
        x, y, length, width, low, high = part[kind]
        albedo, density = _MATERIALS[part.get("material", "paint")]
        solid = make_solids(
            _KINDS[kind],
            [(x, side, (low + high) / 2) for side in ((y, -y) if part.get("mirror") else (y,))],
            (length / 2, width / 2, (high - low) / 2),
            taper=part.get("taper", 1.0),
            lean=part.get("lean", 0.0) / (high - low),
            albedo=albedo or 0.0,
            density=density,
        )
        solids.append(solid)
        painted += [albedo is None] * len(solid)
    return ObjectModel(solids=np.concatenate(solids), painted=np.array(painted), **fields)


OBJECT_MODELS: dict[str, tuple[ObjectModel, ...]] = {
    name: tuple(_make_model(**model) for model in models)
    for name, models in tomllib.loads(Path(__file__).with_name("objects.toml").read_text(encoding="utf-8")).items()
}
"""The models of every class."""


def sample_object_model(rng: np.random.Generator, name: str, *, moving: bool = False) -> ObjectModel:
    """A model of a class, by their shares; ``moving``: one that moves, where the class has one."""
    models = OBJECT_MODELS[name]
    shares = np.cumsum([model.share for model in models])
    able = [model.speed_mps[1] > 0 for model in models]
    while True:
        drawn = int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))
        if able[drawn] or not (moving and any(able)):
            return models[drawn]


def sample_size(rng: np.random.Generator, model: ObjectModel) -> np.ndarray:
    """Length, width and height of a box, metres, within two and a half deviations of the mean."""
    return np.array(model.size_m) + np.array(model.spread) * np.clip(rng.standard_normal(3), -2.5, 2.5)


def sample_paint(rng: np.random.Generator, model: ObjectModel) -> float:
    """Albedo of the painted or woven parts of an object."""
    median, deviation = model.paint
    return float(np.clip(median * np.exp(deviation * rng.standard_normal()), 0.005, 0.8))


def object_solids(model: ObjectModel, size_m: np.ndarray, paint: float) -> np.ndarray:
    """The solids of an object in the frame of its box: origin on the ground in the middle, x forward.

    Args:
        size_m: f64[3], length, width, height of the annotated box.
        paint: albedo of its painted or woven parts.

    >>> cone = OBJECT_MODELS["traffic_cone"][0]
    >>> object_solids(cone, np.array([0.48, 0.48, 0.84]), 0.4)["half"][0].round(3).tolist()
    [0.2, 0.2, 0.02]
    """
    solids = model.solids.copy()
    scale = np.asarray(size_m) - (2 * _MARGIN_M, 2 * _MARGIN_M, _MARGIN_M)
    solids["center"] *= scale
    solids["half"] *= scale
    wheels = solids["kind"] == WHEEL
    solids["half"][wheels, 0] = solids["half"][wheels, 2]
    solids["lean"] *= scale[0] / scale[2]
    solids["albedo"][model.painted] = paint
    return solids
