"""Shapes of objects, composed of solids; sizes drawn from distributions.

A part's place and extent are fractions of its object's box: ``x`` and ``y`` from the middle (forward, left),
``low`` and ``high`` from the ground up. Materials say how bright a part is and how much
of the light it lets through.
"""

import dataclasses
import functools

import numpy as np

from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, SOLID, WHEEL

MARGIN_M = 0.04
"""An annotated box stands off from the solids by this on every side, as hand-drawn boxes do."""

_MATERIALS = {  # albedo (None: the object's own paint) and density
    "paint": (None, np.inf),
    "glass": (0.03, 0.5),
    "rubber": (0.03, np.inf),
    "steel": (0.12, np.inf),
    "plate": (0.4, np.inf),
    "cloth": (None, np.inf),
    "skin": (0.25, np.inf),
    "mesh": (0.12, 6.0),
    "dirt": (0.15, np.inf),
    "screen": (0.08, 40.0),
}


@dataclasses.dataclass(frozen=True)
class Part:
    """A solid of an object, in fractions of the object's box."""

    kind: int
    x: float
    y: float
    l: float
    w: float
    low: float
    high: float
    material: str = "paint"
    taper: tuple[float, float] = (1.0, 1.0)
    lean: float = 0.0
    """How far the part's top stands before its base, in fractions of the box's length."""


@dataclasses.dataclass(frozen=True)
class ObjectModel:
    """One variety of a class."""

    category: str
    """nuScenes category."""
    size_m: tuple[float, float, float]
    """Mean length, width, height."""
    spread: tuple[float, float, float]
    """Standard deviations of the same."""
    parts: tuple[Part, ...]
    share: float = 1.0
    """How often, among the varieties of its class."""
    speed_mps: tuple[float, float] = (0.0, 0.0)
    """Range of speeds when moving; (0, 0) for what never moves."""
    rider: bool = False
    """A person sits on it."""
    paint: tuple[float, float] = (0.1, 0.7)
    """Albedo of its own colour: median, and deviation of the logarithm."""

    @functools.cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The parts as solids in fractions of the box, and which of them bear the object's own colour."""
        rows = np.zeros(len(self.parts), SOLID)
        for row, part in zip(rows, self.parts, strict=True):
            albedo, density = _MATERIALS[part.material]
            height = part.high - part.low
            row["kind"], row["center"] = part.kind, (part.x, part.y, (part.low + part.high) / 2)
            row["half"] = part.l / 2, part.w / 2, height / 2
            row["taper"], row["lean"] = part.taper, part.lean / height
            row["albedo"], row["density"] = albedo or 0, density
        return rows, np.array([_MATERIALS[p.material][0] is None for p in self.parts])


def box(x, y, l, w, low, high, material="paint", taper=(1.0, 1.0), lean=0.0) -> Part:
    """A cuboid; its top may be smaller, along and across."""
    return Part(BOX, x, y, l, w, low, high, material, taper, lean)


def drum(x, y, l, w, low, high, material="paint", top=1.0, lean=0.0) -> Part:
    """An upright cylinder; its top may be smaller."""
    return Part(DRUM, x, y, l, w, low, high, material, (top, 1.0), lean)


def ball(x, y, l, w, low, high, material="paint") -> Part:
    """An ellipsoid."""
    return Part(BALL, x, y, l, w, low, high, material)


def wheels(xs: tuple[float, ...], height: float, y: float = 0.42, width: float = 0.12) -> tuple[Part, ...]:
    """Pairs of wheels (single ones in the middle where ``y`` is 0); their length follows from their height."""
    sides = (y,) if y == 0 else (y, -y)
    return tuple(Part(WHEEL, x, side, 0, width, 0, height, "rubber") for x in xs for side in sides)


def sample_size(rng: np.random.Generator, look: ObjectModel) -> np.ndarray:
    """Length, width and height of a box, metres, within two and a half deviations of the mean."""
    return np.array(look.size_m) + np.array(look.spread) * np.clip(rng.standard_normal(3), -2.5, 2.5)


def sample_paint(rng: np.random.Generator, look: ObjectModel) -> float:
    """Albedo of the painted or woven parts of an object."""
    median, deviation = look.paint
    return float(np.clip(median * np.exp(deviation * rng.standard_normal()), 0.005, 0.8))


def object_solids(look: ObjectModel, size_m: np.ndarray, paint: float) -> np.ndarray:
    """The solids of an object in the frame of its box: origin on the ground in the middle, x forward.

    Args:
        look: which parts.
        size_m: f64[3], length, width, height of the annotated box.
        paint: albedo of its painted or woven parts.

    >>> crate = ObjectModel("movable_object.debris", (1, 1, 1), (0, 0, 0), (box(0, 0, 1, 1, 0, 1),))
    >>> object_solids(crate, np.array([2.08, 1.08, 1.04]), 0.4)["half"].tolist()
    [[1.0, 0.5, 0.5]]
    """
    rows, own = look.rows
    solids = rows.copy()
    scale = np.asarray(size_m) - (2 * MARGIN_M, 2 * MARGIN_M, MARGIN_M)
    solids["center"] *= scale
    solids["half"] *= scale
    wheels = solids["kind"] == WHEEL
    solids["half"][wheels, 0] = solids["half"][wheels, 2]
    solids["lean"] *= scale[0] / scale[2]
    solids["albedo"][own] = paint
    return solids
