"""Buildings along the streets: plain houses, buildings with detailed fronts, and long buildings."""

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.simulation.ground import Side
from fcos_lidar_jax.simulation.solids import BOX, DRUM, make_solids, place_solids

LONG_M = (8, 60)  # length of walls and long buildings
_STOREY_M = 3.2


def houses(rng: Generator, side: Side) -> np.ndarray:
    """Sample cuboids with their fronts at a few distances from the street."""
    s, width = row_of(rng, side.span, (8, 26), (20, 90))
    depth, height = rng.uniform(7, 14, len(s)), np.clip(rng.lognormal(2.1, 0.5, len(s)), 3, 40)
    front = side.back_m + rng.choice([2.0, 8.0, 18.0, 30.0], len(s))
    center, free = side.positions(s, front + depth / 2, np.maximum(width, depth) / 2 + 1)
    halves = np.stack([width, depth, height], axis=1)[free] / 2
    center[:, 2] += halves[:, 2] - 1  # foundations extend below sloping ground
    halves[:, 2] += 1
    return make_solids(BOX, center, halves, yaw=side.yaw, albedo=rng.uniform(0.06, 0.3, len(free)))


def row_of(
    rng: Generator, span: tuple[float, float], length: tuple[float, float], gap: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Sample middles and lengths of elements in a row, half of them with narrow gaps."""
    number = int((span[1] - span[0]) / length[0]) + 1
    lengths = rng.uniform(*length, number)
    gaps = np.where(rng.random(number) < 0.5, rng.uniform(*gap, number), rng.uniform(0, 3, number))
    middles = span[0] + np.cumsum(lengths + gaps) - lengths / 2
    inside = middles < span[1]
    return middles[inside], lengths[inside]


def buildings(rng: Generator, side: Side, setback: float, built: float) -> list[np.ndarray]:
    """Sample detailed buildings; ``built`` is the share of the street side that they take."""
    parts, s = [], side.span[0] + rng.uniform(0, 10)
    while s < side.span[1]:
        width = rng.uniform(6, 28)
        here, s = s + width / 2, s + width + (rng.uniform(0, 1.5) if rng.random() < built else rng.uniform(4, 40))
        if rng.random() > max(built, 0.25):
            continue
        depth, storeys = rng.uniform(7, 15), int(rng.integers(1, 7))
        front = side.ground.pavement + max(setback + rng.choice([0.0, 0.0, rng.normal(0, 1.5)]), 0.2)
        center, _ = side.positions(np.array([here]), side.edge_m + front, max(width / 2, 1.0) + 1)
        for position in center:  # at most one
            building = _building(rng, width, depth, storeys * _STOREY_M)
            parts.append(place_solids(building, np.append(position, side.facing)))
    return parts


def long_buildings(rng: Generator, side: Side, setback: float) -> list[np.ndarray]:
    """Sample long buildings parallel to the street, which may be as close to it as its pavement."""
    parts, s = [], side.span[0]
    while s < side.span[1]:
        width, s = rng.uniform(*LONG_M), s + rng.uniform(0, 60)
        building = _building(rng, width, rng.uniform(7, 15), rng.uniform(3, 12))
        places = s + width * np.array([0.5, 0, 1])  # the middle and both ends
        center, free = side.positions(places, side.back_m + setback, 1.0)
        if len(free) == len(places):
            parts.append(place_solids(building, np.append(center[0], side.facing)))
        s += width
    return parts


def _building(rng: Generator, width: float, depth: float, height: float) -> np.ndarray:
    """Sample one building with its front in the plane x = 0 and the street towards +x."""
    albedo, stone = rng.uniform(0.06, 0.35), rng.uniform(0.1, 0.4)
    solids = [
        make_solids(BOX, [-depth / 2, 0, height / 2 - 1], [depth / 2, width / 2, height / 2 + 1], albedo=albedo)
    ]
    bay = rng.uniform(2.2, 4.5)
    y = np.arange(-width / 2 + bay / 2, width / 2 - bay / 4, bay)
    pilasters, windows, style = rng.uniform(0.1, 0.5), rng.uniform(0.9, 1.6), rng.random(5)
    if style[0] < 0.6:  # storeys of windows; glass reflects little
        floors = np.arange(_STOREY_M / 2 + 0.3, height, _STOREY_M)
        solids.append(make_solids(BOX, _places(0.0, y[:, None], floors), [0.03, windows / 2, 0.7], albedo=0.008))
    if style[1] < 0.45:  # columns or pilasters
        kind, edges = (DRUM if rng.random() < 0.4 else BOX), y - bay / 2
        half = [pilasters / 2, pilasters / 2, height / 2]
        solids.append(make_solids(kind, _places(pilasters / 2, edges, height / 2), half, albedo=stone))
    if style[2] < 0.35:  # bays
        out, low = rng.uniform(0.5, 1.3), rng.choice([0.0, _STOREY_M])
        center = _places(out / 2, y[::2], (low + height * 0.9) / 2)
        half = [out / 2, bay * 0.35, max(height * 0.9 - low, 1) / 2]
        solids.append(make_solids(BOX, center, half, albedo=albedo))
    if style[3] < 0.35 and height > _STOREY_M:  # balconies: a slab and a railing
        out = rng.uniform(0.8, 1.6)
        for floor in np.arange(_STOREY_M, height, _STOREY_M):
            center = _places(out / 2, y[1::2], floor)
            solids.append(make_solids(BOX, center, [out / 2, bay * 0.4, 0.08], albedo=stone))
            railing = center + np.array([out / 2, 0, 0.55])
            solids.append(make_solids(BOX, railing, [0.03, bay * 0.4, 0.5], albedo=0.15, density=8.0))
    for position in rng.choice(y, min(len(y), int(rng.integers(1, 4))), replace=False) if len(y) else ():
        solids += _entrance(rng, float(position), stone)
    if style[4] < 0.3:  # an awning along the front
        out = rng.uniform(0.8, 2.0)
        solids.append(make_solids(BOX, [out / 2, 0, 3.0], [out / 2, width * 0.4, 0.12], albedo=0.3))
    return np.concatenate(solids)


def _places(x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float) -> np.ndarray:
    """Broadcast coordinates and list all positions, f64[k, 3]."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)


def _entrance(rng: Generator, y: float, stone: float) -> list[np.ndarray]:
    """Sample steps, a door frame and, in half of the cases, a canopy on columns."""
    wide, out = rng.uniform(0.7, 1.6), rng.uniform(0.2, 1.6)
    steps = make_solids(BOX, [out / 2, y, 0.1], [out / 2, wide, rng.uniform(0.1, 0.35)], albedo=stone)
    posts = [[0.15, y - wide, 1.3], [0.15, y + wide, 1.3]]
    parts = [steps, make_solids(BOX, posts, [0.15, 0.12, 1.4], albedo=stone)]
    if rng.random() < 0.5:
        parts.append(make_solids(BOX, [out / 2, y, 2.75], [out / 2, wide + 0.2, 0.12], albedo=stone))
        feet = [[out - 0.1, y - wide, 1.3], [out - 0.1, y + wide, 1.3]]
        parts.append(make_solids(DRUM, feet, [0.12, 0.12, 1.4], albedo=stone))
    return parts
