"""The objects of a world: of which kind, how large, where, and how they move."""

import dataclasses

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import footprints_overlap
from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.motion import MOTION, pose_at
from fcos_lidar_jax.simulation.object_models import LOOKS, sample_object_model
from fcos_lidar_jax.simulation.places import PARKED, Places
from fcos_lidar_jax.simulation.shapes import ObjectModel, sample_size

_CLEARANCE_M = 0.35
"""Objects keep this from each other, at all times ..."""
_ROW_CLEARANCE_M = 0.08
"""... but in a row only this."""
_STEP_S = 0.5
"""They are compared at moments so far apart ..."""
_FUSED_STEP_S = 0.025
"""... but in worlds of a few sweeps so often that nothing slips through anything between two sweeps."""
_TRIES = 25
CAR_SIZE_M = (4.6, 2.0)
"""Length and width of the car that carries the sensor."""
CAR_MIDDLE_M = 1.35
"""Its middle is this far before its rear axle."""


@dataclasses.dataclass(frozen=True)
class Traffic:
    """The objects of a world, in the street's frame."""

    labels: np.ndarray
    """i32[m]: index into ``NUSCENES_CLASSES``."""
    looks: tuple[ObjectModel, ...]
    """Variety of each."""
    sizes: np.ndarray
    """f64[m, 3]: length, width, height of the annotated boxes."""
    motions: np.ndarray
    """[m] of ``motion.MOTION``."""
    parked: np.ndarray
    """bool[m]: stands where vehicles are left, rather than in traffic."""


def sample_traffic(
    rng: Generator,
    ground: Ground,
    ego: np.ndarray,
    *,
    labels: np.ndarray,
    reach_m: float,
    duration_s: float,
    occupied: np.ndarray,
    fused: bool = False,
    fast_traffic: bool = False,
) -> Traffic:
    """Objects that never touch each other, the car or what stands already.

    Every object is within reach of the sensor at some moment, at a distance drawn evenly.

    Args:
        rng: draws all of it.
        ground: the streets.
        ego: [1] of ``motion.MOTION``.
        labels: i32[m], wanted; those without room are left out.
        reach_m: greatest distance at that moment.
        duration_s: how long the world lasts.
        occupied: f64[k, 5], ``x, y, l, w, yaw`` of what stands already.
        fused: seen at the end alone: that is the moment at which every object is within reach.
        fast_traffic: nearly all that can move does.
    """
    times = np.arange(0, duration_s + 1e-6, _FUSED_STEP_S if fused else _STEP_S)
    room = _Room(times, occupied)
    car = pose_at(ego, times)
    car[:, :2] += CAR_MIDDLE_M * np.stack([np.cos(car[:, 2]), np.sin(car[:, 2])], axis=1)
    room.take(car, CAR_SIZE_M)
    places = Places(rng, ground, ego, reach_m, fast_traffic)
    found: list[tuple[int, ObjectModel, np.ndarray, np.ndarray, bool]] = []
    for label in labels:
        name = NUSCENES_CLASSES[label]
        for _ in range(_TRIES):
            look = _draw_mover(rng, name) if fast_traffic else sample_object_model(rng, name)
            size = sample_size(rng, look)
            place, clearance = places.sample_place(name, look), _CLEARANCE_M
            moment = rng.uniform(duration_s if fused else 0.0, duration_s)
            if place == "row":
                row, clearance = places.row_for(name, moment, look, size), _ROW_CLEARANCE_M
                if row.look is not look and name in ("traffic_cone", "barrier"):  # in a row all are alike
                    look = row.look
                    size = sample_size(rng, look)
                motion = places.in_row(row, size)
            else:
                motion = places.draw(place, moment, look, size)
            if motion is not None and room.free(pose_at(motion, times), size, clearance):
                room.take(pose_at(motion, times), size)
                found.append((int(label), look, size, motion, place in PARKED))
                break
    return Traffic(
        np.array([f[0] for f in found], np.int32),
        tuple(f[1] for f in found),
        np.array([f[2] for f in found]).reshape(-1, 3),
        np.concatenate([np.zeros(0, MOTION), *(f[3] for f in found)]),
        np.array([f[4] for f in found], bool),
    )


def _draw_mover(rng: Generator, name: str) -> ObjectModel:
    """A variety that moves, of a class that has one."""
    look = sample_object_model(rng, name)
    while look.speed_mps[1] == 0 and any(other.speed_mps[1] > 0 for other in LOOKS[name]):
        look = sample_object_model(rng, name)
    return look


class _Room:
    """Rectangles that are taken, at a few moments."""

    def __init__(self, times: np.ndarray, occupied: np.ndarray) -> None:
        still = np.repeat(occupied[:, None], len(times), axis=1)
        self._poses = list(still[..., [0, 1, 4]])
        self._sizes = [tuple(v) for v in occupied[:, 2:4]]

    def take(self, poses: np.ndarray, size: np.ndarray | tuple[float, float]) -> None:
        self._poses.append(poses)
        self._sizes.append((size[0], size[1]))

    def free(self, poses: np.ndarray, size: np.ndarray, clearance: float) -> bool:
        others, sizes = np.array(self._poses), np.array(self._sizes)
        reach = np.hypot(sizes[:, 0], sizes[:, 1])[:, None] / 2 + np.hypot(size[0], size[1]) / 2 + clearance
        which, when = np.nonzero(np.hypot(*(others[..., :2] - poses[:, :2]).transpose(2, 0, 1)) < reach)
        if not len(which):
            return True
        mine = _footprints(poses[when], np.array([size[0], size[1]]) + 2 * clearance)
        return not footprints_overlap(mine, _footprints(others[which, when], sizes[which])).any()


def _footprints(poses: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Boxes without a height, f64[k, 7], of poses ``x, y, yaw`` and of length and width."""
    boxes = np.zeros((len(poses), 7))
    boxes[:, [0, 1, 6]], boxes[:, 3:5] = poses, sizes
    return boxes
