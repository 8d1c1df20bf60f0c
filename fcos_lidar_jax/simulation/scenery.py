"""Scenery along the streets: buildings, fences, walls, trees and poles."""

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, SOLID, make_solids
from fcos_lidar_jax.simulation.streets import PLAIN, Streets
from fcos_lidar_jax.simulation.surroundings import Side, sample_setting, sample_surroundings

_LEAVES = 0.55  # density of foliage
_FENCES = ((0.08, 5.0), (0.24, np.inf), (0.24, np.inf), (0.8, 2.5))
"""Thickness in metres and density of a fence, walls and a hedge."""


def sample_scenery(
    rng: Generator,
    surroundings: Generator,
    ground: Ground,
    low: np.ndarray,
    high: np.ndarray,
    *,
    beyond_m: float,
    streets: Streets = PLAIN,
) -> np.ndarray:
    """Sample scenery on both sides of both streets.

    Args:
        rng: random source for houses, fences, trees and poles.
        surroundings: random source for everything else.
        low: f64[2], least x and y of the sensor's path.
        high: f64[2], greatest x and y of the sensor's path.
        beyond_m: extent of the scenery around the path.

    Returns:
        solids [s] of :data:`SOLID` in the street frame.
    """
    parts = [np.zeros(0, SOLID)]
    setting = sample_setting(surroundings) if streets.setting else "city"
    plain = [_fences, _trees, _poles] if streets.facades else [_houses, _fences, _trees, _poles]
    for along, half in ((0, ground.half_width), (1, ground.crossing_half_width)):
        span = low[along] - beyond_m, high[along] + beyond_m
        across = ground.crossing_x if along else 0.0
        if not low[1 - along] - beyond_m < across < high[1 - along] + beyond_m:
            continue
        for side in (-1, 1):
            parts += [sample(rng, ground, along, side, half, span) for sample in plain]
            parts.append(sample_surroundings(surroundings, Side(ground, along, side, span), streets, setting))
    return np.concatenate(parts)


def _positions(
    ground: Ground, along: int, side: int, s: np.ndarray, d: np.ndarray | float, clear: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Ground points at ``s`` along and ``d`` beside a street, off carriageways by ``clear``; and their indices."""
    s, d = np.broadcast_arrays(s, d)
    x, y = (s, side * d) if along == 0 else (ground.crossing_x + side * d, s)
    free = np.flatnonzero(~ground.on_road(x, y, clear))
    x, y = x[free], y[free]
    return np.stack([x, y, ground.height(x, y)], axis=1), free


def _spaced(rng: Generator, span: tuple[float, float], mean: float) -> np.ndarray:
    number = max(int((span[1] - span[0]) / mean), 1)
    return np.linspace(*span, number) + rng.uniform(-0.4, 0.4, number) * mean


def _houses(
    rng: Generator, ground: Ground, along: int, side: int, half: float, span: tuple[float, float]
) -> np.ndarray:
    s, width = _row_of(rng, span, (8, 26), (20, 90))
    depth, height = rng.uniform(7, 14, len(s)), np.clip(rng.lognormal(2.1, 0.5, len(s)), 3, 40)
    front = half + ground.pavement + rng.choice([2.0, 8.0, 18.0, 30.0], len(s))
    center, free = _positions(ground, along, side, s, front + depth / 2, np.maximum(width, depth) / 2 + 1)
    halves = np.stack([width, depth, height], axis=1)[free] / 2
    center[:, 2] += halves[:, 2] - 1  # foundations extend below sloping ground
    halves[:, 2] += 1
    return make_solids(BOX, center, halves, yaw=np.pi / 2 * along, albedo=rng.uniform(0.06, 0.3, len(free)))


def _fences(
    rng: Generator, ground: Ground, along: int, side: int, half: float, span: tuple[float, float]
) -> np.ndarray:
    s, length = _row_of(rng, span, (4, 24), (3, 12))
    beside = half + ground.pavement + rng.uniform(0.2, 0.45)
    center, free = _positions(ground, along, side, s, beside, length / 2 + ground.pavement)
    kind = rng.integers(0, len(_FENCES), len(free))
    thick, density = np.array(_FENCES)[kind].T
    tall = rng.uniform(0.8, 2.2, len(free))
    halves = np.stack([length[free] / 2, thick / 2, tall / 2], axis=1)
    center[:, 2] += tall / 2
    albedo = rng.uniform(0.08, 0.3, len(free))
    return make_solids(BOX, center, halves, yaw=np.pi / 2 * along, albedo=albedo, density=density)


def _row_of(
    rng: Generator, span: tuple[float, float], length: tuple[float, float], gap: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Middles and lengths of elements in a row, half of them with narrow gaps."""
    number = int((span[1] - span[0]) / length[0]) + 1
    lengths = rng.uniform(*length, number)
    gaps = np.where(rng.random(number) < 0.5, rng.uniform(*gap, number), rng.uniform(0, 3, number))
    middles = span[0] + np.cumsum(lengths + gaps) - lengths / 2
    inside = middles < span[1]
    return middles[inside], lengths[inside]


def _trees(
    rng: Generator, ground: Ground, along: int, side: int, half: float, span: tuple[float, float]
) -> np.ndarray:
    """Sample trees at the kerb and further back, and bushes."""
    kerb, back = _spaced(rng, span, 45), _spaced(rng, span, 25)
    far = ground.pavement + rng.uniform(1, 12, len(back))
    s, d = np.concatenate([kerb, back]), half + np.concatenate([np.full(len(kerb), 1.0), far])
    center, free = _positions(ground, along, side, s, d, 0.5)
    trunk, clear = rng.uniform(0.08, 0.22, len(free)), rng.uniform(2.2, 3.2, len(free))
    crown = np.stack([rng.uniform(1.2, 2.8, len(free))] * 2 + [rng.uniform(1.2, 3.2, len(free))], axis=1)
    stem = center.copy()
    stem[:, 2] += clear / 2
    stems = make_solids(DRUM, stem, np.stack([trunk, trunk, clear / 2 + 0.3], axis=1), taper=(0.8, 1), albedo=0.15)
    center[:, 2] += clear + crown[:, 2] * 0.85
    crowns = make_solids(BALL, center, crown, albedo=rng.uniform(0.1, 0.25, len(free)), density=_LEAVES)
    bush, _ = _positions(ground, along, side, _spaced(rng, span, 25), half + ground.pavement + 0.8, 0.5)
    size = rng.uniform(0.4, 1.1, (len(bush), 3))
    bushes = make_solids(BALL, bush + size * (0, 0, 0.8), size, albedo=0.2, density=2.5)
    return np.concatenate([stems, crowns, bushes])


def _poles(
    rng: Generator, ground: Ground, along: int, side: int, half: float, span: tuple[float, float]
) -> np.ndarray:
    s = _spaced(rng, span, 14)
    center, _ = _positions(ground, along, side, s, np.full(len(s), half + 0.45), 0.3)
    lamp = rng.random(len(center)) < 0.5
    radius, tall = np.where(lamp, 0.09, 0.04), np.where(lamp, rng.uniform(5, 9, len(center)), 2.8)
    foot = center + np.stack([np.zeros_like(tall), np.zeros_like(tall), tall / 2], axis=1)
    posts = make_solids(DRUM, foot, np.stack([radius, radius, tall / 2], axis=1), taper=(0.7, 1), albedo=0.2)
    plates = center[~lamp] + (0, 0, 2.5)
    signs = make_solids(BOX, plates, (0.03, 0.32, 0.32), yaw=np.pi / 2 * along, albedo=0.9)
    return np.concatenate([posts, signs])
