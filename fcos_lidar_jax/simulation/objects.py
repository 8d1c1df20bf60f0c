"""Object models of the ten classes, from ``objects.toml``, and the solids of objects."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, WHEEL, make_solids

_MARGIN_M = 0.04  # gap between solids and their annotated box on each side, as in manual annotations
_KINDS = {"box": BOX, "drum": DRUM, "ball": BALL, "wheel": WHEEL}
_GLOSSY = ("vehicle.car", "vehicle.truck", "vehicle.bus", "vehicle.trailer", "vehicle.construction")
_GLOSS_DEVIATION = 0.2  # of the vehicles of a world
_GLASS_GLOSS = 2.5  # gloss of glass relative to paint
_FULL = 0.96  # parts that reach this share of the box determine its extent
_MATERIALS = {  # albedo (None for the object's paint) and density
    "paint": (None, np.inf),
    "glass": (0.03, 0.5),
    "rubber": (0.03, np.inf),
    "steel": (0.12, np.inf),
    "plate": (0.4, np.inf),
    "cloth": (None, np.inf),
    "skin": (0.25, np.inf),
    "dirt": (0.15, np.inf),
    "screen": (0.08, 40.0),
    "leaves": (0.15, 3.0),
    "mesh": (0.12, 4.0),
    "stone": (0.2, np.inf),
    "wood": (0.15, np.inf),
}


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectModel:
    """One model of a class; ``objects.toml`` explains the fields."""

    category: str  # nuScenes category
    size_m: list[float]
    spread: list[float]
    share: float
    solids: np.ndarray  # [s], in fractions of the box
    painted: np.ndarray  # bool[s]: True for solids in the object's paint
    speed_mps: tuple[float, float] = (0.0, 0.0)
    paint: tuple[float, float] = (0.1, 0.7)
    rider: bool = False
    city_share: float | None = None


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


def _read_models(file: str) -> dict[str, tuple[ObjectModel, ...]]:
    tables = tomllib.loads(Path(__file__).with_name(file).read_text(encoding="utf-8"))
    return {name: tuple(_make_model(**model) for model in models) for name, models in tables.items()}


OBJECT_MODELS = _read_models("objects.toml")
"""Models by class."""

CLUTTER_MODELS = _read_models("clutter.toml")
"""Models of clutter, which is not annotated, by location."""


def sample_object_model(
    rng: np.random.Generator, name: str, *, moving: bool = False, city: bool = False
) -> ObjectModel:
    """Sample a model of a class by share; with ``moving``, a model that can move if the class has any."""
    models = OBJECT_MODELS[name]
    in_city = [model.share if model.city_share is None else model.city_share for model in models]
    shares = np.cumsum(in_city if city else [model.share for model in models])
    able = [model.speed_mps[1] > 0 for model in models]
    while True:
        index = int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))
        if able[index] or not (moving and any(able)):
            return models[index]


def sample_size(rng: np.random.Generator, model: ObjectModel, factor: float = 1.0) -> np.ndarray:
    """Sample length, width, height in metres, up to 2.5 deviations from the mean; ``factor`` scales deviations."""
    return np.array(model.size_m) + factor * np.array(model.spread) * np.clip(rng.standard_normal(3), -2.5, 2.5)


def sample_paint(rng: np.random.Generator, model: ObjectModel) -> float:
    """Sample the albedo of the painted or cloth parts of an object."""
    median, deviation = model.paint
    return float(np.clip(median * np.exp(deviation * rng.standard_normal()), 0.005, 0.8))


def object_solids(model: ObjectModel, size_m: np.ndarray, paint: float) -> np.ndarray:
    """Solids of an object in the frame of its box: origin at the middle of the bottom face, x forward.

    Args:
        size_m: f64[3], length, width, height of the annotated box.
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


def polish(rng: np.random.Generator, model: ObjectModel, solids: np.ndarray, gloss: float) -> None:
    """Make the paint and the glass of a vehicle glossy in place, around a mean gloss; other objects stay matt.

    Args:
        solids: [s], of the model.
        gloss: share of the grazing rays that paint reflects away, 0 to 1; glass loses more.
    """
    if not model.category.startswith(_GLOSSY):
        return
    own = np.clip(gloss + _GLOSS_DEVIATION * rng.standard_normal(), 0, 1)
    glass = np.isclose(solids["density"], _MATERIALS["glass"][1])
    solids["gloss"] = own * np.where(glass, _GLASS_GLOSS, model.painted)


def vary_shape(rng: np.random.Generator, solids: np.ndarray, size_m: np.ndarray, deviation: float) -> None:
    """Vary the extents of an object's parts in place and independently, such that the box stays tight.

    Sides of parts at a side of the box do not move. Wheels and parts that extend beyond the box, such as the fence
    on a barrier, keep their shapes. Only parts that are wider at the top, such as the body of a dump truck,
    may then extend beyond it by decimetres.

    Args:
        solids: [s], in the frames of their boxes.
        size_m: f64[3] or f64[s, 3], size of the annotated boxes.
        deviation: standard deviation of a side, as a fraction of the part's extent.
    """
    low, high = solids["center"] - solids["half"], solids["center"] + solids["half"]
    least, most = size_m * (-0.5, -0.5, 0), size_m * (0.5, 0.5, 1)
    inside = np.all((low >= least - 1e-6) & (high <= most + 1e-6), axis=1)
    near = (1 - _FULL) / 2 * size_m + _MARGIN_M
    free = inside[:, None] & (solids["kind"] != WHEEL)[:, None]
    step = 2 * solids["half"] * deviation * rng.standard_normal((2, *low.shape))
    low = np.where(free & (low > least + near), np.maximum(low + step[0], least), low)
    high = np.where(free & (high < most - near), np.minimum(high + step[1], most), high)
    solids["center"], solids["half"] = (low + high) / 2, (high - low) / 2
