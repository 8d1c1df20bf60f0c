"""Where objects stand and how they move: lanes, kerbs, yards, pavements, work zones."""

import dataclasses

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.motion import MOTION, pose_at, travelled
from fcos_lidar_jax.simulation.shapes import ObjectModel

LANE_M = 3.5
PARKED = ("row", "kerb", "yard")
"""Places where vehicles are left."""
_ROW_LENGTH = {"car": 8, "trailer": 5, "traffic_cone": 8, "barrier": 14}
"""Objects in a row, at most."""
_FAST = 0.7
"""Of the objects of a world of fast traffic that get the first of their class's places, where they move."""
_FLOWING = {0: 0.8, 1: 0.4}
"""How often traffic moves in a lane of the main street and of the other."""

_PLACES: dict[str, tuple[tuple[str, float], ...]] = {
    "car": (("lane", 0.5), ("row", 0.42), ("yard", 0.08)),
    "truck": (("lane", 0.4), ("kerb", 0.3), ("yard", 0.3)),
    "bus": (("lane", 0.75), ("yard", 0.25)),
    "trailer": (("lane", 0.15), ("kerb", 0.05), ("row", 0.8)),
    "construction_vehicle": (("lane", 0.15), ("kerb", 0.45), ("yard", 0.4)),
    "pedestrian": (("pavement", 0.8), ("crossing", 0.2)),
    "motorcycle": (("lane", 0.5), ("kerb", 0.5)),
    "bicycle": (("cycle", 0.5), ("pavement", 0.5)),
    "traffic_cone": (("row", 1.0),),
    "barrier": (("row", 1.0),),
}


@dataclasses.dataclass
class Row:
    """Cones or barriers of a work zone, or parked cars or trailers, in line along one side of a street."""

    along: int
    """0 main street, 1 the other."""
    end: float
    """Where the last one ends, along the street."""
    beside: float
    """Left of the street's middle, metres."""
    gap: float
    """Between one and the next."""
    left: int
    """How many more it takes."""
    across: bool
    """They face the row's other side, as barriers do; otherwise along it."""
    look: ObjectModel
    """Variety of its cones or barriers."""


@dataclasses.dataclass
class Places:
    """The streets as those see them who look for a place."""

    rng: Generator
    """Draws all of it."""
    ground: Ground
    """The streets."""
    ego: np.ndarray
    """[1] of ``motion.MOTION``: the car that carries the sensor."""
    reach_m: float
    """Greatest distance from it, at the moment of a draw."""
    fast_traffic: bool = False
    """Every lane flows, fast and steadily, and few stand."""
    rows: dict[str, Row] = dataclasses.field(default_factory=dict)
    """Class -> the row that is being filled."""
    flows: dict[tuple[int, int, int], tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Street, side and lane -> speed and its change, the same for all in the lane: they keep their distances."""

    def sample_place(self, name: str, look: ObjectModel) -> str:
        """A place that suits the variety: what is ridden is on the road, a cycle without a rider stands."""
        names, shares = zip(*_PLACES[name], strict=True)
        if name in ("motorcycle", "bicycle"):
            return names[0] if look.rider else names[1]
        if self.fast_traffic and self.rng.random() < _FAST:
            return names[0]
        drawn = np.searchsorted(np.cumsum(shares), self.rng.random(), side="right")
        return names[min(int(drawn), len(names) - 1)]

    def row_for(self, name: str, moment: float, look: ObjectModel, size: np.ndarray) -> Row:
        """The row of a class with room for one more; a new one for this look and size where there is none."""
        if name not in self.rows or self.rows[name].left == 0:
            self.rows[name] = self._draw_row(name, moment, look, size)
        return self.rows[name]

    def in_row(self, row: Row, size: np.ndarray) -> np.ndarray:
        """The next place of a row, [1] of ``motion.MOTION``."""
        extent = size[1] if row.across else size[0]
        s = row.end + row.gap + extent / 2
        row.end, row.left = s + extent / 2, row.left - 1
        turn = np.pi / 2 * np.sign(row.beside) if row.across else np.pi * (row.beside > 0)
        noise = self.rng.normal(0, (0.06, 0.03))
        return self._motion(row.along, s, row.beside + noise[0], turn + noise[1])

    def draw(self, place: str, moment: float, look: ObjectModel, size: np.ndarray) -> np.ndarray | None:
        """A motion that is at such a place at a moment, [1] of ``motion.MOTION``; None where that fails."""
        rng, ground = self.rng, self.ground
        along, s = self._draw_station(moment)
        half = self._half(along)
        side = int(rng.choice([-1, 1]))
        turn = 0.0 if side < 0 else np.pi  # traffic keeps to the right
        speed, change = 0.0, 0.0
        if place == "lane":
            lane = int(rng.integers(max(int((half - 2.4) // LANE_M), 1)))
            beside, turn = side * LANE_M * (lane + 0.5), turn + rng.normal(0, 0.01)
            speed, change = self._flow(along, side, lane)
        elif place == "kerb":
            beside, turn = side * (half - size[1] / 2 - rng.uniform(0.1, 0.4)), turn + rng.normal(0, 0.03)
        elif place == "cycle":
            beside, turn = side * (half - 2.7 + rng.normal(0, 0.15)), turn + rng.normal(0, 0.03)
            speed = rng.uniform(*look.speed_mps)
        elif place == "yard":
            beside = side * (half + ground.pavement + size[0] / 2 + rng.uniform(0.5, 15))
            turn = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.12)
        elif place == "crossing":
            if along == 0 and rng.random() < 0.7:  # on the zebra
                s = ground.crossing_x + rng.choice([-1, 1]) * (ground.crossing_half_width + rng.uniform(2, 4))
            beside, turn = rng.uniform(-half, half), side * np.pi / 2 + rng.normal(0, 0.1)
            speed = rng.uniform(*look.speed_mps)
        else:  # pavement
            beside = side * (half + rng.uniform(1.6, max(ground.pavement - 0.4, 1.7)))
            moves = look.speed_mps[1] > 0 and (self.fast_traffic or rng.random() < 0.75)
            speed = rng.uniform(*look.speed_mps) if moves else 0.0
            turn = rng.choice([0.0, np.pi]) + rng.normal(0, 0.15) if moves else rng.uniform(-np.pi, np.pi)
        motion = self._motion(along, s, beside, turn, speed, change)
        way, _ = travelled(motion, moment)
        motion["x"] -= way * np.cos(motion["yaw"])
        motion["y"] -= way * np.sin(motion["yaw"])
        if place in ("pavement", "yard") and ground.on_road(motion["x"], motion["y"]).any():
            return None
        return motion

    def _half(self, along: int) -> float:
        return self.ground.crossing_half_width if along else self.ground.half_width

    def _flow(self, along: int, side: int, lane: int) -> tuple[float, float]:
        """Speed and its change in a lane; in the car's own lane they are the car's."""
        if (along, side, lane) not in self.flows:
            rng = self.rng
            if self.fast_traffic:
                flow = (rng.uniform(8, 18), 0.0)
            else:
                flow = (rng.uniform(3, 12), rng.choice([0.0, 0.0, 0.0, -0.5, -1.5, 0.5]))
            if along == 0 and np.isclose(side * LANE_M * (lane + 0.5), self.ego["y"][0]):
                flow = (self.ego["speed"][0], self.ego["acceleration"][0])
            elif not self.fast_traffic and rng.random() > _FLOWING[along]:
                flow = (0.0, 0.0)
            self.flows[along, side, lane] = float(flow[0]), float(flow[1])
        return self.flows[along, side, lane]

    def _draw_row(self, name: str, moment: float, look: ObjectModel, size: np.ndarray) -> Row:
        rng, pavement = self.rng, self.ground.pavement
        along, s = self._draw_station(moment)
        half, side = self._half(along), rng.choice([-1, 1])
        left, across, gap = int(rng.integers(2, _ROW_LENGTH[name] + 1)), True, 0.25
        if name in ("traffic_cone", "barrier"):
            beside = half - rng.uniform(0.6, 2.6)
            gap = rng.uniform(1.0, 3.5) if name == "traffic_cone" or rng.random() < 0.3 else gap
        elif name == "trailer" or rng.random() < 0.6:  # side by side off the street
            beside, gap = half + pavement + size[0] / 2 + rng.uniform(1.5, 14), rng.uniform(0.5, 1.2)
        else:  # one after the other at the kerb
            beside, gap, across = half - size[1] / 2 - rng.uniform(0.1, 0.4), rng.uniform(0.5, 2.5), False
        return Row(along, s, side * beside, gap, left, across, look)

    def _draw_station(self, moment: float) -> tuple[int, float]:
        """A street (0 main, 1 the other) and a place along it, by its distance from the sensor at a moment."""
        x, y, _ = pose_at(self.ego, moment)[0]
        distance = self.reach_m * self.rng.uniform(0.05, 1)
        on = []
        for along, (here, off) in enumerate(((x, y), (y, x - self.ground.crossing_x))):
            if distance > abs(off):
                way = np.sqrt(distance**2 - off**2)
                on += [(along, here - way), (along, here + way)]
        if not on:
            return 0, x + self.rng.choice([-1, 1]) * distance
        return on[int(self.rng.integers(len(on)))]

    def _motion(
        self, along: int, s: float, beside: float, turn: float, speed: float = 0.0, change: float = 0.0
    ) -> np.ndarray:
        """A straight motion from a place along a street and beside its middle (left of its direction)."""
        motion = np.zeros(1, MOTION)
        motion["x"], motion["y"] = (s, beside) if along == 0 else (self.ground.crossing_x - beside, s)
        motion["yaw"] = turn + along * np.pi / 2
        motion["speed"], motion["acceleration"] = speed, change
        return motion
