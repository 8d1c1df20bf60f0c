"""The objects of a world: their models, sizes, places (lanes, kerbs, yards, pavements) and motions."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import footprints_overlap
from fcos_lidar_jax.simulation.ground import LANE_M, Ground
from fcos_lidar_jax.simulation.motion import MOTION, make_motion, pose_at, travelled
from fcos_lidar_jax.simulation.objects import ObjectModel, sample_object_model, sample_size
from fcos_lidar_jax.simulation.streets import Streets

# Places of each class with their probabilities. The first place is the one with moving objects, if there is any.
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
_ROW_LENGTH = {"car": 8, "trailer": 5, "traffic_cone": 8, "barrier": 14}  # maximum number of objects in a row
_DEPOT_LENGTH = (4, 12)  # minimum and maximum number of trailers in a depot
_DEPOT_GAP_M = (0.12, 0.5)  # gap between trailers of a depot
_DEPOT_DISORDER = 0.2  # factor of the deviations of places and headings in a depot
_FAST = 0.7  # share of the objects in fast traffic that use the first place of their class
_FLOWING = {0: 0.8, 1: 0.4}  # probability that a lane moves, in the main street and the crossing street
_CLEARANCE_M = 0.35  # minimum gap between objects at all times
_ROW_CLEARANCE_M = 0.08  # minimum gap within a row
_STEP_S = 0.5  # interval between the times at which gaps are checked
_FUSED_STEP_S = 0.025  # interval in worlds of a few sweeps, short enough that no object passes through another
_ROUNDING_M = 1e-6  # tolerance, so that rounding cannot reject a disc whose rectangle is in reach
_TRIES = 25
EGO_SIZE_M = (4.6, 2.0)  # length and width of the ego vehicle
EGO_MIDDLE_M = 1.35  # distance of its middle ahead of its rear axle


@dataclasses.dataclass(frozen=True)
class Traffic:
    """The objects of a world, in the street frame."""

    labels: np.ndarray  # i32[m]: index into NUSCENES_CLASSES
    models: tuple[ObjectModel, ...]  # model of each object
    sizes: np.ndarray  # f64[m, 3]: length, width, height of the annotated boxes
    motions: np.ndarray  # [m] of motion.MOTION
    parked: np.ndarray  # bool[m]: True for objects at parking places, False for objects in traffic


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
    streets: Streets,
) -> Traffic:
    """Sample objects that do not touch each other, the ego vehicle or the scenery near the ground.

    In long worlds this holds every half second: fast objects may pass through others in between. Each object, or
    the row it stands in, begins beside a place of a street within ``reach_m`` of the ego vehicle at some time,
    at a distance distributed by ``streets.spread``. For the other options see :func:`~.world.sample_world`.

    Args:
        ego: [1] of ``motion.MOTION``.
        labels: classes of the objects, placed in this order; objects without room are omitted.
        occupied: f64[k, 5], ``x, y, l, w, yaw`` of the scenery.
    """
    times = np.arange(0, duration_s + 1e-6, _FUSED_STEP_S if fused else _STEP_S)
    occupancy = _Occupancy(times, occupied)
    vehicle = pose_at(ego, times)
    vehicle[:, :2] += EGO_MIDDLE_M * np.stack([np.cos(vehicle[:, 2]), np.sin(vehicle[:, 2])], axis=1)
    occupancy.add(vehicle, EGO_SIZE_M)
    groups, pedestrian = rng.spawn(1)[0], None
    places = _Places(rng, ground, ego, reach_m, fast_traffic, streets, groups.spawn(1)[0])
    objects: list[tuple[int, ObjectModel, np.ndarray, np.ndarray, bool]] = []
    for label in labels:
        name = NUSCENES_CLASSES[label]
        for _ in range(_TRIES):
            model = sample_object_model(rng, name, moving=fast_traffic, city=streets.round_cars)
            size = sample_size(rng, model, streets.sizes)
            place, clearance = places.sample_place(name, model), _CLEARANCE_M
            moment = rng.uniform(duration_s if fused else 0.0, duration_s)
            if place == "row":
                row, clearance = places.row_for(name, moment, model, size), _ROW_CLEARANCE_M
                if row.model is not model and row.equal:
                    model = row.model
                    size = sample_size(rng, model, streets.sizes)
                motion = places.next_in_row(row, size)
            elif pedestrian is not None and name == "pedestrian" and groups.random() < streets.groups:
                motion, clearance = pedestrian.copy(), _ROW_CLEARANCE_M
                motion["x"] += groups.normal(0, 1.2)
                motion["y"] += groups.normal(0, 0.8)
            else:
                motion = places.sample_motion(place, moment, model, size)
            if motion is not None and occupancy.has_room(pose_at(motion, times), size, clearance):
                occupancy.add(pose_at(motion, times), size)
                objects.append((label, model, size, motion, place in _PARKED))
                pedestrian = motion if name == "pedestrian" else pedestrian
                break
    placed, models, sizes, motions, parked = zip(*objects, strict=True) if objects else [()] * 5
    return Traffic(
        np.array(placed, np.int32),
        models,
        np.array(sizes).reshape(-1, 3),
        np.concatenate([np.zeros(0, MOTION), *motions]),
        np.array(parked, bool),
    )


class _Occupancy:
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
        # Enclosing discs quickly exclude rectangles that are too far away at all times.
        x, y, radius = _discs(poses[None], size[None])[0]
        other_x, other_y, radii = self._discs.T
        near = np.hypot(other_x - x, other_y - y) < radii + radius + clearance + _ROUNDING_M
        others, sizes = self._poses[near], self._sizes[near]
        reach = np.hypot(sizes[:, 0], sizes[:, 1])[:, None] / 2 + np.hypot(size[0], size[1]) / 2 + clearance
        which, when = np.nonzero(np.hypot(*(others[..., :2] - poses[:, :2]).transpose(2, 0, 1)) < reach)
        own = _footprints(poses[when], size[:2] + 2 * clearance)
        return not footprints_overlap(own, _footprints(others[which, when], sizes[which])).any()


def _discs(poses: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Discs ``x, y, radius`` that enclose rectangles at all times, f64[k, 3], from poses [k, times, 3]."""
    low, high = poses[..., :2].min(axis=1), poses[..., :2].max(axis=1)
    radii = (np.hypot(*(high - low).T) + np.hypot(sizes[:, 0], sizes[:, 1])) / 2
    return np.column_stack([(low + high) / 2, radii])


def _footprints(poses: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Boxes of zero height, f64[k, 7], from poses ``x, y, yaw`` and length and width."""
    boxes = np.zeros((len(poses), 7))
    boxes[:, [0, 1, 6]], boxes[:, 3:5] = poses, sizes
    return boxes


@dataclasses.dataclass
class _Row:
    """A row of cones or barriers of a work zone, or of parked cars or trailers, along one side of a street."""

    along: int  # 0 main street, 1 crossing street
    end: float  # end of the last object, metres along the street
    side: int  # 1 to the left of the street, -1 to the right
    beside: float  # the same end, metres to the left of the middle of the street
    gap: float  # gap between objects, metres
    left: int  # number of objects still to place
    across: bool  # objects face the street, as barriers do; otherwise they face along it
    model: ObjectModel  # model of the first object
    equal: bool  # all objects have this model
    disorder: float = 1.0  # factor of the deviations of places and headings
    curvature: float = 0.0  # 1/m, positive to the left
    angle: float = 0.0  # direction at the end of the row, relative to the street


@dataclasses.dataclass
class _Places:
    rng: Generator
    ground: Ground
    ego: np.ndarray
    reach_m: float  # maximum distance from the ego vehicle
    fast_traffic: bool  # all lanes flow fast and steadily, and few objects stand
    streets: Streets
    shapes: Generator  # random source of curved rows and depots
    # The unfinished row of each class.
    rows: dict[str, _Row] = dataclasses.field(default_factory=dict)
    # Speed and acceleration by (street, side, lane). Vehicles of a lane share them, which keeps their gaps.
    flows: dict[tuple[int, int, int], tuple[float, float]] = dataclasses.field(default_factory=dict)

    def sample_place(self, name: str, model: ObjectModel) -> str:
        """Sample a place that suits the model: cycles are on the road with a rider and parked without one."""
        names, shares = zip(*_PLACES[name], strict=True)
        if name in ("motorcycle", "bicycle"):
            return names[0] if model.rider else names[1]
        if self.fast_traffic and self.rng.random() < _FAST:
            return names[0]
        index = np.searchsorted(np.cumsum(shares), self.rng.random(), side="right")
        return names[min(int(index), len(names) - 1)]

    def row_for(self, name: str, moment: float, model: ObjectModel, size: np.ndarray) -> _Row:
        """Row of a class with room for another object; a new row for this model and size if there is none."""
        if name not in self.rows or self.rows[name].left == 0:
            self.rows[name] = self._sample_row(name, moment, model, size)
        return self.rows[name]

    def next_in_row(self, row: _Row, size: np.ndarray) -> np.ndarray:
        """Motion at the next place of a row, [1] of ``motion.MOTION``."""
        extent = size[1] if row.across else size[0]
        ahead, aside = np.cos(row.angle), np.sin(row.angle)
        s, beside = row.end + row.gap * ahead + extent / 2 * ahead, row.beside + (row.gap + extent / 2) * aside
        turn = np.pi / 2 * row.side if row.across else np.pi * (row.side > 0)
        noise = row.disorder * self.rng.normal(0, (0.06, 0.03))
        motion = self._motion(row.along, s, beside + noise[0], turn + row.angle + noise[1])
        row.end, row.beside, row.left = s + extent / 2 * ahead, beside + extent / 2 * aside, row.left - 1
        row.angle += row.curvature * (row.gap + extent)
        return motion

    def sample_motion(self, place: str, moment: float, model: ObjectModel, size: np.ndarray) -> np.ndarray | None:
        """Sample a motion that is at a place at a moment, [1] of ``motion.MOTION``; None on failure."""
        rng, ground = self.rng, self.ground
        along, s = self._sample_station(moment)
        half = self._half(along)
        side = int(rng.choice([-1, 1]))
        turn = 0.0 if side < 0 else np.pi  # right-hand traffic
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
        distance, _ = travelled(motion, moment)
        motion["x"] -= distance * np.cos(motion["yaw"])
        motion["y"] -= distance * np.sin(motion["yaw"])
        if place in ("pavement", "yard") and ground.on_road(motion["x"], motion["y"]).any():
            return None
        return motion

    def _half(self, along: int) -> float:
        return self.ground.crossing_half_width if along else self.ground.half_width

    def _flow(self, along: int, side: int, lane: int) -> tuple[float, float]:
        """Speed and acceleration of a lane. The lane of the ego vehicle follows the ego vehicle."""
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
        left, across, gap, disorder, curvature = int(rng.integers(2, _ROW_LENGTH[name] + 1)), True, 0.25, 1.0, 0.0
        equal = name in ("traffic_cone", "barrier")
        if equal:
            beside = half - rng.uniform(0.6, 2.6)
            gap = rng.uniform(1.0, 3.5) if name == "traffic_cone" or rng.random() < 0.3 else gap
            if self.streets.bends:
                curvature = float(self.shapes.normal(0, self.streets.bends))
        elif name == "trailer" or rng.random() < 0.6:  # side by side, off the street
            beside, gap = half + pavement + size[0] / 2 + rng.uniform(1.5, 14), rng.uniform(0.5, 1.2)
        else:  # in line, at the kerb
            beside, gap, across = half - size[1] / 2 - rng.uniform(0.1, 0.4), rng.uniform(0.5, 2.5), False
        if name == "trailer" and self.streets.depots and self.shapes.random() < self.streets.depots:
            left = int(self.shapes.integers(*_DEPOT_LENGTH, endpoint=True))
            gap = self.shapes.uniform(*_DEPOT_GAP_M)
            equal, disorder = True, _DEPOT_DISORDER
        return _Row(along, s, side, side * beside, gap, left, across, model, equal, disorder, curvature)

    def _sample_station(self, moment: float) -> tuple[int, float]:
        """Sample a street (0 main, 1 crossing) and a position along it, by distance from the ego vehicle."""
        x, y, _ = pose_at(self.ego, moment)[0]
        distance = self.reach_m * self.rng.uniform(0.05, 1) ** self.streets.spread
        stations = []
        for along, (position, offset) in enumerate(((x, y), (y, x - self.ground.crossing_x))):
            if distance > abs(offset):
                ahead = np.sqrt(distance**2 - offset**2)
                stations += [(along, position - ahead), (along, position + ahead)]
        if not stations:
            return 0, x + self.rng.choice([-1, 1]) * distance
        return stations[int(self.rng.integers(len(stations)))]

    def _motion(
        self, along: int, s: float, beside: float, turn: float, speed: float = 0.0, change: float = 0.0
    ) -> np.ndarray:
        """Straight motion from a position ``s`` along a street and ``beside`` its middle."""
        x, y = (s, beside) if along == 0 else (self.ground.crossing_x - beside, s)
        return make_motion(x=x, y=y, yaw=turn + along * np.pi / 2, speed=speed, acceleration=change)
