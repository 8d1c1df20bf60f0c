"""The objects of a world: which, how large, where they stand (lanes, kerbs, yards, pavements), how they move."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import footprints_overlap
from fcos_lidar_jax.simulation.ground import LANE_M, Ground
from fcos_lidar_jax.simulation.motion import MOTION, make_motion, pose_at, travelled
from fcos_lidar_jax.simulation.objects import ObjectModel, sample_object_model, sample_size
from fcos_lidar_jax.simulation.streets import PLAIN, Streets

# Where objects of a class are, and how often; first where they move, if they do.
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
_PARKED = ("row", "kerb", "yard")
_ROW_LENGTH = {"car": 8, "trailer": 5, "traffic_cone": 8, "barrier": 14}  # objects in a row, at most
_FAST = 0.7  # share of the objects in fast traffic that get the first of their class's places
_FLOWING = {0: 0.8, 1: 0.4}  # how often traffic moves in a lane of the main street and of the other
_CLEARANCE_M = 0.35  # objects keep this from each other, at all times
_ROW_CLEARANCE_M = 0.08  # but in a row only this
_STEP_S = 0.5  # they are compared at moments so far apart
_FUSED_STEP_S = 0.025  # but in worlds of a few sweeps so often that nothing slips through between two of them
_ROUNDING_M = 1e-6  # of a distance, so that no disc is taken for further away than its rectangle
_TRIES = 25
EGO_SIZE_M = (4.6, 2.0)  # length and width of the ego vehicle
EGO_MIDDLE_M = 1.35  # its middle is this far before its rear axle


@dataclasses.dataclass(frozen=True)
class Traffic:
    """The objects of a world, in the street's frame."""

    labels: np.ndarray  # i32[m]: index into NUSCENES_CLASSES
    models: tuple[ObjectModel, ...]  # model of each
    sizes: np.ndarray  # f64[m, 3]: length, width, height of the annotated boxes
    motions: np.ndarray  # [m] of motion.MOTION
    parked: np.ndarray  # bool[m]: stands where vehicles are left, rather than in traffic


def sample_traffic(
    rng: Generator,
    ground: Ground,
    ego: np.ndarray,
    *,
    labels: Sequence[int],
    occupied: np.ndarray,
    reach_m: float,
    duration_s: float,
    fused: bool,
    fast_traffic: bool,
    streets: Streets = PLAIN,
) -> Traffic:
    """Objects that never touch each other, the ego vehicle or what stands already.

    Every object is within reach of the sensor at some moment, at a distance drawn evenly or as the streets say.
    Options are those of :func:`~.world.sample_world`.

    Args:
        ego: [1] of ``motion.MOTION``.
        labels: wanted, in this order; those without room are left out.
        occupied: f64[k, 5], ``x, y, l, w, yaw`` of what stands already.
    """
    times = np.arange(0, duration_s + 1e-6, _FUSED_STEP_S if fused else _STEP_S)
    taken = _Taken(times, occupied)
    vehicle = pose_at(ego, times)
    vehicle[:, :2] += EGO_MIDDLE_M * np.stack([np.cos(vehicle[:, 2]), np.sin(vehicle[:, 2])], axis=1)
    taken.add(vehicle, EGO_SIZE_M)
    places = _Places(rng, ground, ego, reach_m, fast_traffic, streets.spread)
    groups, walker = rng.spawn(1)[0], None
    found: list[tuple[int, ObjectModel, np.ndarray, np.ndarray, bool]] = []
    for label in labels:
        name = NUSCENES_CLASSES[label]
        for _ in range(_TRIES):
            model = sample_object_model(rng, name, moving=fast_traffic, city=streets.round_cars)
            size = sample_size(rng, model, streets.sizes)
            place, clearance = places.sample_place(name, model), _CLEARANCE_M
            moment = rng.uniform(duration_s if fused else 0.0, duration_s)
            if place == "row":
                row, clearance = places.row_for(name, moment, model, size), _ROW_CLEARANCE_M
                if row.model is not model and name in ("traffic_cone", "barrier"):  # in a row all are alike
                    model = row.model
                    size = sample_size(rng, model, streets.sizes)
                motion = places.next_in_row(row, size)
            elif walker is not None and name == "pedestrian" and groups.random() < streets.groups:
                motion, clearance = walker.copy(), _ROW_CLEARANCE_M
                motion["x"] += groups.normal(0, 1.2)
                motion["y"] += groups.normal(0, 0.8)
            else:
                motion = places.sample_motion(place, moment, model, size)
            if motion is not None and taken.has_room(pose_at(motion, times), size, clearance):
                taken.add(pose_at(motion, times), size)
                found.append((label, model, size, motion, place in _PARKED))
                walker = motion if name == "pedestrian" else walker
                break
    return Traffic(
        np.array([f[0] for f in found], np.int32),
        tuple(f[1] for f in found),
        np.array([f[2] for f in found]).reshape(-1, 3),
        np.concatenate([np.zeros(0, MOTION), *(f[3] for f in found)]),
        np.array([f[4] for f in found], bool),
    )


class _Taken:
    """Rectangles on the ground that are taken, at a few moments."""

    def __init__(self, times: np.ndarray, occupied: np.ndarray) -> None:
        self._poses = np.repeat(occupied[:, None, [0, 1, 4]], len(times), axis=1)
        self._sizes = occupied[:, 2:4]
        self._discs = _discs(self._poses, self._sizes)

    def add(self, poses: np.ndarray, size: np.ndarray | tuple[float, float]) -> None:
        sizes = np.array([[size[0], size[1]]])
        self._poses = np.concatenate([self._poses, poses[None]])
        self._sizes = np.concatenate([self._sizes, sizes])
        self._discs = np.concatenate([self._discs, _discs(poses[None], sizes)])

    def has_room(self, poses: np.ndarray, size: np.ndarray, clearance: float) -> bool:
        # Most are too far away at every moment, which takes less to see than where they are at each.
        x, y, radius = _discs(poses[None], size[None])[0]
        there_x, there_y, radii = self._discs.T
        near = np.hypot(there_x - x, there_y - y) < radii + radius + clearance + _ROUNDING_M
        others, sizes = self._poses[near], self._sizes[near]
        reach = np.hypot(sizes[:, 0], sizes[:, 1])[:, None] / 2 + np.hypot(size[0], size[1]) / 2 + clearance
        which, when = np.nonzero(np.hypot(*(others[..., :2] - poses[:, :2]).transpose(2, 0, 1)) < reach)
        own = _footprints(poses[when], size[:2] + 2 * clearance)
        return not footprints_overlap(own, _footprints(others[which, when], sizes[which])).any()


def _discs(poses: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Discs that hold rectangles at all their moments, f64[k, 3], ``x, y, radius``, of poses [k, moments, 3]."""
    low, high = poses[..., :2].min(axis=1), poses[..., :2].max(axis=1)
    radii = (np.hypot(*(high - low).T) + np.hypot(sizes[:, 0], sizes[:, 1])) / 2
    return np.column_stack([(low + high) / 2, radii])


def _footprints(poses: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Boxes without a height, f64[k, 7], of poses ``x, y, yaw`` and of length and width."""
    boxes = np.zeros((len(poses), 7))
    boxes[:, [0, 1, 6]], boxes[:, 3:5] = poses, sizes
    return boxes


@dataclasses.dataclass
class _Row:
    """Cones or barriers of a work zone, or parked cars or trailers, in line along one side of a street."""

    along: int  # 0 main street, 1 the other
    end: float  # where the last one ends, along the street
    beside: float  # left of the street's middle, metres
    gap: float  # between one and the next
    left: int  # how many more it takes
    across: bool  # they face the street, as barriers do; otherwise along it
    model: ObjectModel  # of its cones or barriers


@dataclasses.dataclass
class _Places:
    """Samples places and motions of objects in the streets."""

    rng: Generator
    ground: Ground
    ego: np.ndarray
    reach_m: float  # greatest distance from the ego vehicle
    fast_traffic: bool  # every lane flows, fast and steadily, and few stand
    spread: float  # power of an even number that says how far off an object is
    # Class -> the row that is being filled.
    rows: dict[str, _Row] = dataclasses.field(default_factory=dict)
    # Street, side and lane -> speed and acceleration, the same for all in the lane: they keep their distances.
    flows: dict[tuple[int, int, int], tuple[float, float]] = dataclasses.field(default_factory=dict)

    def sample_place(self, name: str, model: ObjectModel) -> str:
        """A place that suits the model: what is ridden is on the road, a cycle without a rider stands."""
        names, shares = zip(*_PLACES[name], strict=True)
        if name in ("motorcycle", "bicycle"):
            return names[0] if model.rider else names[1]
        if self.fast_traffic and self.rng.random() < _FAST:
            return names[0]
        drawn = np.searchsorted(np.cumsum(shares), self.rng.random(), side="right")
        return names[min(int(drawn), len(names) - 1)]

    def row_for(self, name: str, moment: float, model: ObjectModel, size: np.ndarray) -> _Row:
        """The row of a class with room for one more; a new one for this model and size where there is none."""
        if name not in self.rows or self.rows[name].left == 0:
            self.rows[name] = self._sample_row(name, moment, model, size)
        return self.rows[name]

    def next_in_row(self, row: _Row, size: np.ndarray) -> np.ndarray:
        """The next place of a row, [1] of ``motion.MOTION``."""
        extent = size[1] if row.across else size[0]
        s = row.end + row.gap + extent / 2
        row.end, row.left = s + extent / 2, row.left - 1
        turn = np.pi / 2 * np.sign(row.beside) if row.across else np.pi * (row.beside > 0)
        noise = self.rng.normal(0, (0.06, 0.03))
        return self._motion(row.along, s, row.beside + noise[0], turn + noise[1])

    def sample_motion(self, place: str, moment: float, model: ObjectModel, size: np.ndarray) -> np.ndarray | None:
        """A motion that is at such a place at a moment, [1] of ``motion.MOTION``; None where that fails."""
        rng, ground = self.rng, self.ground
        along, s = self._sample_station(moment)
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
            speed = rng.uniform(*model.speed_mps)
        elif place == "yard":
            beside = side * (half + ground.pavement + size[0] / 2 + rng.uniform(0.5, 15))
            turn = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.12)
        elif place == "crossing":
            if along == 0 and rng.random() < 0.7:  # on the zebra
                s = ground.crossing_x + rng.choice([-1, 1]) * (ground.crossing_half_width + rng.uniform(2, 4))
            beside, turn = rng.uniform(-half, half), side * np.pi / 2 + rng.normal(0, 0.1)
            speed = rng.uniform(*model.speed_mps)
        else:  # pavement
            beside = side * (half + rng.uniform(1.6, max(ground.pavement - 0.4, 1.7)))
            moves = model.speed_mps[1] > 0 and (self.fast_traffic or rng.random() < 0.75)
            speed = rng.uniform(*model.speed_mps) if moves else 0.0
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
        """Speed and acceleration in a lane; in the ego vehicle's lane they are its own."""
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

    def _sample_row(self, name: str, moment: float, model: ObjectModel, size: np.ndarray) -> _Row:
        rng, pavement = self.rng, self.ground.pavement
        along, s = self._sample_station(moment)
        half, side = self._half(along), rng.choice([-1, 1])
        left, across, gap = int(rng.integers(2, _ROW_LENGTH[name] + 1)), True, 0.25
        if name in ("traffic_cone", "barrier"):
            beside = half - rng.uniform(0.6, 2.6)
            gap = rng.uniform(1.0, 3.5) if name == "traffic_cone" or rng.random() < 0.3 else gap
        elif name == "trailer" or rng.random() < 0.6:  # side by side off the street
            beside, gap = half + pavement + size[0] / 2 + rng.uniform(1.5, 14), rng.uniform(0.5, 1.2)
        else:  # one after the other at the kerb
            beside, gap, across = half - size[1] / 2 - rng.uniform(0.1, 0.4), rng.uniform(0.5, 2.5), False
        return _Row(along, s, side * beside, gap, left, across, model)

    def _sample_station(self, moment: float) -> tuple[int, float]:
        """A street (0 main, 1 the other) and a place along it, by its distance from the sensor at a moment."""
        x, y, _ = pose_at(self.ego, moment)[0]
        distance = self.reach_m * self.rng.uniform(0.05, 1) ** self.spread
        stations = []
        for along, (here, off) in enumerate(((x, y), (y, x - self.ground.crossing_x))):
            if distance > abs(off):
                way = np.sqrt(distance**2 - off**2)
                stations += [(along, here - way), (along, here + way)]
        if not stations:
            return 0, x + self.rng.choice([-1, 1]) * distance
        return stations[int(self.rng.integers(len(stations)))]

    def _motion(
        self, along: int, s: float, beside: float, turn: float, speed: float = 0.0, change: float = 0.0
    ) -> np.ndarray:
        """A straight motion from a place along a street and beside its middle (left of its direction)."""
        x, y = (s, beside) if along == 0 else (self.ground.crossing_x - beside, s)
        return make_motion(x=x, y=y, yaw=turn + along * np.pi / 2, speed=speed, acceleration=change)
