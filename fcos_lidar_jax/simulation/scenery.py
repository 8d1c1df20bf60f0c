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
    """Sample scenery on both sides of both streets, solids [s] of :data:`SOLID` in the street frame.

    Args:
        rng, surroundings: random sources for houses, fences, trees and poles, and for everything else.
        low, high: f64[2], least and greatest x and y of the sensor's path.
        beyond_m: extent of the scenery around the path.
    """
    parts = [np.zeros(0, SOLID)]
    setting = sample_setting(surroundings) if streets.setting else "city"
    plain = [_fences, _trees, _poles] if streets.facades else [_houses, _fences, _trees, _poles]
    for along, across in ((0, 0.0), (1, ground.crossing_x)):
        if not low[1 - along] - beyond_m < across < high[1 - along] + beyond_m:
            continue
        for left in (-1, 1):
            side = Side(ground, along, left, (low[along] - beyond_m, high[along] + beyond_m))
            parts += [sample(rng, side) for sample in plain]
            parts.append(sample_surroundings(surroundings, side, streets, setting))
    return np.concatenate(parts)


def _spaced(rng: Generator, span: tuple[float, float], mean: float) -> np.ndarray:
    number = max(int((span[1] - span[0]) / mean), 1)
    return np.linspace(*span, number) + rng.uniform(-0.4, 0.4, number) * mean


def _houses(rng: Generator, side: Side) -> np.ndarray:
    s, width = _row_of(rng, side.span, (8, 26), (20, 90))
    depth, height = rng.uniform(7, 14, len(s)), np.clip(rng.lognormal(2.1, 0.5, len(s)), 3, 40)
    front = side.back_m + rng.choice([2.0, 8.0, 18.0, 30.0], len(s))
    center, free = side.positions(s, front + depth / 2, np.maximum(width, depth) / 2 + 1)
    halves = np.stack([width, depth, height], axis=1)[free] / 2
    center[:, 2] += halves[:, 2] - 1  # foundations extend below sloping ground
    halves[:, 2] += 1
    return make_solids(BOX, center, halves, yaw=side.yaw, albedo=rng.uniform(0.06, 0.3, len(free)))


def _fences(rng: Generator, side: Side) -> np.ndarray:
    s, length = _row_of(rng, side.span, (4, 24), (3, 12))
    beside = side.back_m + rng.uniform(0.2, 0.45)
    center, free = side.positions(s, beside, length / 2 + side.ground.pavement)
    kind = rng.integers(0, len(_FENCES), len(free))
    thick, density = np.array(_FENCES)[kind].T
    tall = rng.uniform(0.8, 2.2, len(free))
    halves = np.stack([length[free] / 2, thick / 2, tall / 2], axis=1)
    center[:, 2] += tall / 2
    albedo = rng.uniform(0.08, 0.3, len(free))
    return make_solids(BOX, center, halves, yaw=side.yaw, albedo=albedo, density=density)


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


def _trees(rng: Generator, side: Side) -> np.ndarray:
    kerb, back = _spaced(rng, side.span, 45), _spaced(rng, side.span, 25)
    far = side.ground.pavement + rng.uniform(1, 12, len(back))
    s, d = np.concatenate([kerb, back]), side.edge_m + np.concatenate([np.full(len(kerb), 1.0), far])
    center, free = side.positions(s, d, 0.5)
    trunk, clear = rng.uniform(0.08, 0.22, len(free)), rng.uniform(2.2, 3.2, len(free))
    crown = np.stack([rng.uniform(1.2, 2.8, len(free))] * 2 + [rng.uniform(1.2, 3.2, len(free))], axis=1)
    stem = center.copy()
    stem[:, 2] += clear / 2
    stems = make_solids(DRUM, stem, np.stack([trunk, trunk, clear / 2 + 0.3], axis=1), taper=(0.8, 1), albedo=0.15)
    center[:, 2] += clear + crown[:, 2] * 0.85
    crowns = make_solids(BALL, center, crown, albedo=rng.uniform(0.1, 0.25, len(free)), density=_LEAVES)
    bush, _ = side.positions(_spaced(rng, side.span, 25), side.back_m + 0.8, 0.5)
    size = rng.uniform(0.4, 1.1, (len(bush), 3))
    bushes = make_solids(BALL, bush + size * (0, 0, 0.8), size, albedo=0.2, density=2.5)
    return np.concatenate([stems, crowns, bushes])


def _poles(rng: Generator, side: Side) -> np.ndarray:
    center, _ = side.positions(_spaced(rng, side.span, 14), side.edge_m + 0.45, 0.3)
    lamp = rng.random(len(center)) < 0.5
    radius, tall = np.where(lamp, 0.09, 0.04), np.where(lamp, rng.uniform(5, 9, len(center)), 2.8)
    foot = center + tall[:, None] / 2 * (0, 0, 1)
    posts = make_solids(DRUM, foot, np.stack([radius, radius, tall / 2], axis=1), taper=(0.7, 1), albedo=0.2)
    plates = center[~lamp] + (0, 0, 2.5)
    signs = make_solids(BOX, plates, (0.03, 0.32, 0.32), yaw=side.yaw, albedo=0.9)
    return np.concatenate([posts, signs])
