"""Surroundings of varied streets: detailed buildings, trees and clutter."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.simulation.ground import Ground
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

_STOREY_M = 3.2
_VARIED = 0.08  # deviation of the sides of clutter parts
_GROUPS = (1, 1, 1, 2, 3, 5)  # sizes of groups of equal things
_LONG_M = (8, 60)  # length of walls and long buildings
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


@dataclasses.dataclass(frozen=True)
class Side:
    """A section of one side of a street."""

    ground: Ground
    along: int  # 0 main street, 1 crossing street
    side: int  # 1 to the left of the street's direction, -1 to the right
    span: tuple[float, float]  # metres along the street

    @property
    def edge_m(self) -> float:
        """Distance of the kerb from the middle of the street."""
        return self.ground.crossing_half_width if self.along else self.ground.half_width

    @property
    def back_m(self) -> float:
        """Distance of the back of the pavement from the middle of the street."""
        return self.edge_m + self.ground.pavement

    @property
    def length_m(self) -> float:
        return self.span[1] - self.span[0]

    @property
    def yaw(self) -> float:
        return np.pi / 2 * self.along

    @property
    def facing(self) -> float:
        """Direction from the side to the street, radians."""
        return (1 + self.side) * np.pi / 2 if self.along else -self.side * np.pi / 2

    def free(
        self, s: np.ndarray, away: np.ndarray | float, clear: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions ``x, y`` at ``s`` along and ``away`` from the middle of the street; and their indices.

        Positions on carriageways or closer to them than ``clear`` are omitted.
        """
        beside = self.side * away + np.zeros(len(s))
        x, y = (self.ground.crossing_x + beside, s) if self.along else (s, beside)
        free = np.flatnonzero(~self.ground.on_road(x, y, clear))
        return x[free], y[free], free

    def positions(
        self, s: np.ndarray, away: np.ndarray | float, clear: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Like :meth:`free`, on the ground: positions f64[k, 3], and their indices."""
        x, y, free = self.free(s, away, clear)
        return np.stack([x, y, self.ground.height(x, y)], axis=1), free


def sample_surroundings(rng: Generator, side: Side, streets: Streets, setting: str) -> np.ndarray:
    """Sample everything along one side of a street, as solids [s] in the street frame."""
    built, cluttered = rng.spawn(2)
    walled = built.spawn(1)[0]
    parts = [np.zeros(0, SOLID)]
    setback = float(built.uniform(*_SETBACK_M[setting]))
    if streets.facades:
        parts += _buildings(built, side, setback, _BUILT[setting])
    if walled.random() < streets.walls:
        parts += _walls(walled, side)
    if walled.random() < streets.walls:
        parts += _long_buildings(walled, side, setback)
    if streets.clutter:
        dense = streets.clutter * _DENSITY[setting] * np.exp(0.5 * cluttered.standard_normal())
        parts += _trees(cluttered, side, _TREES[setting] * np.exp(0.5 * cluttered.standard_normal()))
        parts += _clutter(cluttered, side, dense, setback)
        parts += _wires(cluttered, side)
    return np.concatenate(parts)


def sample_setting(rng: Generator) -> str:
    """Sample the setting of a world, such as ``"city"``."""
    return str(rng.choice(list(_SETTINGS), p=list(_SETTINGS.values())))


def _buildings(rng: Generator, side: Side, setback: float, built: float) -> list[np.ndarray]:
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


def _long_buildings(rng: Generator, side: Side, setback: float) -> list[np.ndarray]:
    """Sample long buildings parallel to the street, which may be as close to it as its pavement."""
    parts, s = [], side.span[0]
    while s < side.span[1]:
        width, s = rng.uniform(*_LONG_M), s + rng.uniform(0, 60)
        building = _building(rng, width, rng.uniform(7, 15), rng.uniform(3, 12))
        places = s + width * np.array([0.5, 0, 1])  # the middle and both ends
        center, free = side.positions(places, side.back_m + setback, 1.0)
        if len(free) == len(places):
            parts.append(place_solids(building, np.append(center[0], side.facing)))
        s += width
    return parts


def _walls(rng: Generator, side: Side) -> list[np.ndarray]:
    """Sample walls, fences or hedges of the same kind and height behind the pavement, with gaps between them."""
    thickness, density, albedo = _WALLS[rng.integers(len(_WALLS))]
    height, away, s, parts = rng.uniform(0.5, 2.8), side.back_m + rng.uniform(0.1, 2.5), side.span[0], []
    while s < side.span[1]:
        length, s = rng.uniform(*_LONG_M), s + rng.uniform(1.5, 40)
        pieces = s + np.arange(_PIECE_M / 2, length, _PIECE_M)  # short pieces, which follow the ground
        center, _ = side.positions(pieces, away, _PIECE_M / 2)
        center[:, 2] += height / 2 - _FOUNDATION_M / 2
        half = [thickness / 2, _PIECE_M / 2, height / 2 + _FOUNDATION_M / 2]
        parts.append(make_solids(BOX, center, half, yaw=side.facing, albedo=albedo, density=density))
        s += length
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


def _trees(rng: Generator, side: Side, density: float) -> list[np.ndarray]:
    """Sample trees in a row at the kerb and scattered trees behind the pavement."""
    number = int(rng.poisson(density * side.length_m))
    s = rng.uniform(*side.span, number)
    behind = side.ground.pavement + rng.uniform(0.5, 25, number)
    beyond = np.where(rng.random(number) < 0.45, rng.uniform(0.5, 1.2), behind)
    center, free = side.positions(s, side.edge_m + beyond, 0.3)
    number = len(free)
    trunk, clear = rng.uniform(0.07, 0.35, number), rng.uniform(1.6, 4.0, number)
    radius, tall = rng.uniform(1.0, 3.8, number), rng.uniform(1.0, 3.6, number)
    middle, half = center + clear[:, None] / 2 * (0, 0, 1), np.stack([trunk, trunk, clear / 2 + 0.8], axis=1)
    stems = make_solids(DRUM, middle, half, taper=(0.75, 1), albedo=0.15, lean=rng.normal(0, 0.05, number))
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


def _wires(rng: Generator, side: Side) -> list[np.ndarray]:
    """Sample wires along the street, on 30 % of the sides."""
    if rng.random() > 0.3:
        return []
    number = int(rng.integers(1, 4))
    middle, half = np.full(number, sum(side.span) / 2), [0.02, side.length_m / 2, 0.02]
    center, _ = side.positions(middle, side.edge_m + rng.uniform(0.3, 2.0, number), -1e3)
    center[:, 2] += rng.uniform(4.5, 8, len(center))
    return [make_solids(BOX, center, half, yaw=side.facing, albedo=0.1, density=30.0)]
