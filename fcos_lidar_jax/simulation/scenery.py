"""Scenery along the streets: buildings, fences, walls, trees, poles, wires and clutter."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.simulation.buildings import LONG_M, buildings, houses, long_buildings, row_of
from fcos_lidar_jax.simulation.ground import Ground, Side
from fcos_lidar_jax.simulation.objects import (
    CLUTTER_MODELS,
    ObjectModel,
    object_solids,
    sample_paint,
    sample_size,
    vary_shape,
)
from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, SOLID, make_solids, place_solids
from fcos_lidar_jax.simulation.streets import Streets

_LEAVES = 0.55  # density of foliage
_FENCES = ((0.08, 5.0), (0.24, np.inf), (0.24, np.inf), (0.8, 2.5))
"""Thickness in metres and density of a fence, walls and a hedge."""
_VARIED = 0.08  # deviation of the sides of clutter parts
_GROUPS = (1, 1, 1, 2, 3, 5)  # sizes of groups of equal things
_PIECE_M = 3.0
_FOUNDATION_M = 0.4  # depth of walls below the ground
_WALLS = ((0.2, np.inf, 0.1), (0.3, np.inf, 0.25), (0.06, 25.0, 0.15), (0.9, 3.0, 0.2))
"""Thickness in metres, density and albedo of two walls, a fence and a hedge."""
_SETTINGS = {"city": 0.4, "suburb": 0.3, "works": 0.15, "open": 0.15}
# By setting: share of the street side with buildings, setback of their fronts in metres, trees per metre of street
# side, and factor of the clutter.
_BUILT = {"city": 0.95, "suburb": 0.7, "works": 0.4, "open": 0.08}
_SETBACK_M = {"city": (0.3, 4.0), "suburb": (3.0, 14.0), "works": (4.0, 25.0), "open": (10.0, 35.0)}
_TREES = {"city": 0.03, "suburb": 0.07, "works": 0.02, "open": 0.05}
_DENSITY = {"city": 1.3, "suburb": 1.0, "works": 1.2, "open": 0.5}


def sample_scenery(
    rng: Generator,
    surroundings: Generator,
    ground: Ground,
    low: np.ndarray,
    high: np.ndarray,
    *,
    beyond_m: float,
    streets: Streets,
) -> np.ndarray:
    """Sample scenery on both sides of both streets, solids [s] of :data:`SOLID` in the street frame.

    Args:
        rng, surroundings: random sources for houses, fences, trees and poles, and for everything else.
        low, high: f64[2], least and greatest x and y of the sensor's path.
        beyond_m: extent of the scenery around the path.
    """
    parts = [np.zeros(0, SOLID)]
    setting = "city"
    if streets.setting:
        setting = str(surroundings.choice(list(_SETTINGS), p=list(_SETTINGS.values())))
    plain = [] if streets.facades else [houses]
    plain += [_fences, _rows_of_trees, _poles]
    for along, across in ((0, 0.0), (1, ground.crossing_x)):
        if not low[1 - along] - beyond_m < across < high[1 - along] + beyond_m:
            continue
        for left in (-1, 1):
            side = Side(ground, along, left, (low[along] - beyond_m, high[along] + beyond_m))
            parts += [sample(rng, side) for sample in plain]
            parts.append(sample_side(surroundings, side, streets, setting))
    return np.concatenate(parts)


def sample_side(rng: Generator, side: Side, streets: Streets, setting: str) -> np.ndarray:
    """Sample what varied streets add along one side of a street, as solids [s] in the street frame."""
    built, cluttered = rng.spawn(2)
    walled = built.spawn(1)[0]
    parts = [np.zeros(0, SOLID)]
    setback = float(built.uniform(*_SETBACK_M[setting]))
    if streets.facades:
        parts += buildings(built, side, setback, _BUILT[setting])
    if walled.random() < streets.walls:
        parts += _walls(walled, side)
    if walled.random() < streets.walls:
        parts += long_buildings(walled, side, setback)
    if streets.clutter:
        dense = streets.clutter * _DENSITY[setting] * np.exp(0.5 * cluttered.standard_normal())
        parts += _scattered_trees(cluttered, side, _TREES[setting] * np.exp(0.5 * cluttered.standard_normal()))
        parts += _clutter(cluttered, side, dense, setback)
        parts += _wires(cluttered, side)
    return np.concatenate(parts)


def _spaced(rng: Generator, span: tuple[float, float], mean: float) -> np.ndarray:
    number = max(int((span[1] - span[0]) / mean), 1)
    return np.linspace(*span, number) + rng.uniform(-0.4, 0.4, number) * mean


def _fences(rng: Generator, side: Side) -> np.ndarray:
    s, length = row_of(rng, side.span, (4, 24), (3, 12))
    beside = side.back_m + rng.uniform(0.2, 0.45)
    center, free = side.positions(s, beside, length / 2 + side.ground.pavement)
    kind = rng.integers(0, len(_FENCES), len(free))
    thick, density = np.array(_FENCES)[kind].T
    tall = rng.uniform(0.8, 2.2, len(free))
    halves = np.stack([length[free] / 2, thick / 2, tall / 2], axis=1)
    center[:, 2] += tall / 2
    albedo = rng.uniform(0.08, 0.3, len(free))
    return make_solids(BOX, center, halves, yaw=side.yaw, albedo=albedo, density=density)


def _walls(rng: Generator, side: Side) -> list[np.ndarray]:
    """Sample walls, fences or hedges of the same kind and height behind the pavement, with gaps between them."""
    thickness, density, albedo = _WALLS[rng.integers(len(_WALLS))]
    height, away, s, parts = rng.uniform(0.5, 2.8), side.back_m + rng.uniform(0.1, 2.5), side.span[0], []
    while s < side.span[1]:
        length, s = rng.uniform(*LONG_M), s + rng.uniform(1.5, 40)
        pieces = s + np.arange(_PIECE_M / 2, length, _PIECE_M)  # short pieces, which follow the ground
        center, _ = side.positions(pieces, away, _PIECE_M / 2)
        center[:, 2] += height / 2 - _FOUNDATION_M / 2
        half = [thickness / 2, _PIECE_M / 2, height / 2 + _FOUNDATION_M / 2]
        parts.append(make_solids(BOX, center, half, yaw=side.facing, albedo=albedo, density=density))
        s += length
    return parts


def _rows_of_trees(rng: Generator, side: Side) -> np.ndarray:
    kerb, back = _spaced(rng, side.span, 45), _spaced(rng, side.span, 25)
    far = side.ground.pavement + rng.uniform(1, 12, len(back))
    s, d = np.concatenate([kerb, back]), side.edge_m + np.concatenate([np.full(len(kerb), 1.0), far])
    center, free = side.positions(s, d, 0.5)
    trunk, clear = rng.uniform(0.08, 0.22, len(free)), rng.uniform(2.2, 3.2, len(free))
    crown = np.stack([rng.uniform(1.2, 2.8, len(free))] * 2 + [rng.uniform(1.2, 3.2, len(free))], axis=1)
    stems = _stems(center, trunk, clear, 0.3, taper=(0.8, 1))
    center[:, 2] += clear + crown[:, 2] * 0.85
    crowns = make_solids(BALL, center, crown, albedo=rng.uniform(0.1, 0.25, len(free)), density=_LEAVES)
    bush, _ = side.positions(_spaced(rng, side.span, 25), side.back_m + 0.8, 0.5)
    size = rng.uniform(0.4, 1.1, (len(bush), 3))
    bushes = make_solids(BALL, bush + size * (0, 0, 0.8), size, albedo=0.2, density=2.5)
    return np.concatenate([stems, crowns, bushes])


def _scattered_trees(rng: Generator, side: Side, density: float) -> list[np.ndarray]:
    """Sample trees in a row at the kerb and scattered trees behind the pavement."""
    number = int(rng.poisson(density * side.length_m))
    s = rng.uniform(*side.span, number)
    behind = side.ground.pavement + rng.uniform(0.5, 25, number)
    beyond = np.where(rng.random(number) < 0.45, rng.uniform(0.5, 1.2), behind)
    center, free = side.positions(s, side.edge_m + beyond, 0.3)
    number = len(free)
    trunk, clear = rng.uniform(0.07, 0.35, number), rng.uniform(1.6, 4.0, number)
    radius, tall = rng.uniform(1.0, 3.8, number), rng.uniform(1.0, 3.6, number)
    stems = _stems(center, trunk, clear, 0.8, taper=(0.75, 1), lean=rng.normal(0, 0.05, number))
    # A crown has three parts of different density.
    crowns = []
    for share in (1.0, 0.7, 0.6):
        off = np.stack(
            [*rng.normal(0, 0.3, (2, number)) * radius, clear + tall * rng.uniform(0.7, 1.3, number)], axis=1
        )
        size = share * np.stack([radius, radius, tall], axis=1)
        leaves = rng.uniform(0.25, 1.6, number)
        crowns.append(make_solids(BALL, center + off, size, albedo=rng.uniform(0.08, 0.3, number), density=leaves))
    return [stems, *crowns]


def _stems(
    foot: np.ndarray, radius: np.ndarray, height: np.ndarray, buried_m: float, **fields: object
) -> np.ndarray:
    half = np.stack([radius, radius, height / 2 + buried_m], axis=1)
    return make_solids(DRUM, foot + height[:, None] / 2 * (0, 0, 1), half, albedo=0.15, **fields)


def _poles(rng: Generator, side: Side) -> np.ndarray:
    center, _ = side.positions(_spaced(rng, side.span, 14), side.edge_m + 0.45, 0.3)
    lamp = rng.random(len(center)) < 0.5
    radius, tall = np.where(lamp, 0.09, 0.04), np.where(lamp, rng.uniform(5, 9, len(center)), 2.8)
    foot = center + tall[:, None] / 2 * (0, 0, 1)
    posts = make_solids(DRUM, foot, np.stack([radius, radius, tall / 2], axis=1), taper=(0.7, 1), albedo=0.2)
    plates = center[~lamp] + (0, 0, 2.5)
    signs = make_solids(BOX, plates, (0.03, 0.32, 0.32), yaw=side.yaw, albedo=0.9)
    return np.concatenate([posts, signs])


def _wires(rng: Generator, side: Side) -> list[np.ndarray]:
    """Sample wires along the street, on 30 % of the sides."""
    if rng.random() > 0.3:
        return []
    number = int(rng.integers(1, 4))
    middle, half = np.full(number, sum(side.span) / 2), [0.02, side.length_m / 2, 0.02]
    center, _ = side.positions(middle, side.edge_m + rng.uniform(0.3, 2.0, number), -1e3)
    center[:, 2] += rng.uniform(4.5, 8, len(center))
    return [make_solids(BOX, center, half, yaw=side.facing, albedo=0.1, density=30.0)]


def _clutter(rng: Generator, side: Side, density: float, setback: float) -> list[np.ndarray]:
    pavement, things = side.ground.pavement, []
    beyond = {
        "kerb": (0.25, 0.9),
        "wall": (pavement - 0.4, pavement + max(setback, 1.0)),
        "open": (pavement + 0.5, 26),
    }
    for place, models in CLUTTER_MODELS.items():
        shares = np.array([model.share for model in models])
        left = int(rng.poisson(density * side.length_m))
        for model in rng.choice(len(models), left, p=shares / shares.sum()):
            group = min(left, int(_GROUPS[rng.integers(len(_GROUPS))]))
            if not group:
                break
            left -= group
            things.append(_sample_group(rng, side, models[model], group, beyond[place]))
            if place == "open":
                things[-1].poses[2] += rng.uniform(-np.pi, np.pi)
    return [_vary(rng, side.ground, things)] if things else []


class _Group(NamedTuple):
    model: ObjectModel
    size_m: np.ndarray  # f64[3]
    poses: np.ndarray  # f64[3, k]: x, y, yaw


def _sample_group(
    rng: Generator, side: Side, model: ObjectModel, number: int, beyond: tuple[float, float]
) -> _Group:
    """Sample equal things in line along the street."""
    size = np.maximum(sample_size(rng, model), 0.4 * np.array(model.size_m))
    s = rng.uniform(*side.span) + np.arange(number) * (size[1] + rng.uniform(0.1, 3)) + rng.normal(0, 0.1, number)
    away = rng.uniform(*beyond) + size[0] / 2 + rng.normal(0, 0.05, number)
    x, y, free = side.free(s, side.edge_m + away, size[0] / 2)
    turn = rng.normal(0, 0.06) + rng.normal(0, 0.03, len(free))
    return _Group(model, size, np.stack([x, y, side.facing + turn]))


def _vary(rng: Generator, ground: Ground, groups: list[_Group]) -> np.ndarray:
    """Solids of all groups, with an individual shape, albedo and density per thing."""
    solids = [object_solids(group.model, group.size_m, sample_paint(rng, group.model)) for group in groups]
    each = [group.poses.shape[1] for group in groups]
    parts = np.concatenate([np.tile(thing, number) for thing, number in zip(solids, each, strict=True)])
    num_parts = np.repeat([len(thing) for thing in solids], each)
    sizes = np.repeat([group.size_m for group in groups], each, axis=0)
    vary_shape(rng, parts, np.repeat(sizes, num_parts, axis=0), _VARIED)
    parts["albedo"] *= np.repeat(np.exp(0.3 * rng.standard_normal(len(num_parts))), num_parts)
    parts["density"] *= np.repeat(np.exp(0.5 * rng.standard_normal(len(num_parts))), num_parts)
    x, y, yaw = np.concatenate([group.poses for group in groups], axis=1)
    poses = np.stack([x, y, ground.height(x, y), yaw], axis=1)
    return place_solids(parts, np.repeat(poses, num_parts, axis=0))
