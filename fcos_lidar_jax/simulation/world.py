"""A simulated world of streets, scenery, traffic and the ego vehicle."""

import dataclasses

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.simulation.ground import LANE_M, Ground, sample_relief
from fcos_lidar_jax.simulation.motion import make_motion, pose_at
from fcos_lidar_jax.simulation.objects import OBJECT_MODELS, object_solids, polish, sample_paint, vary_shape
from fcos_lidar_jax.simulation.scenery import sample_scenery
from fcos_lidar_jax.simulation.solids import SOLID, place_solids
from fcos_lidar_jax.simulation.streets import PLAIN, Streets
from fcos_lidar_jax.simulation.traffic import Traffic, sample_traffic

_SHARES = np.array([0.36, 0.08, 0.02, 0.04, 0.015, 0.17, 0.015, 0.02, 0.09, 0.19])
"""Shares of the classes in nuScenes, in the order of NUSCENES_CLASSES."""
_MANOEUVRES = ("straight", "straight", "left", "right", "stopped", "braking", "starting")


@dataclasses.dataclass(frozen=True)
class World:
    """All contents of a world in the street frame: x along the main street, y to the left, z up."""

    ground: Ground
    scenery: np.ndarray  # [s], static solids
    traffic: Traffic
    parts: np.ndarray  # [s], solids of the objects, each in the frame of its owner
    ego: np.ndarray  # [1] of motion.MOTION: motion of the rear axle of the ego vehicle
    streets: Streets = PLAIN
    unit_seed: int = 0  # seed of the properties of the sensor's lasers

    def object_poses(self, time_s: float) -> np.ndarray:
        """Poses ``x, y, z, yaw`` of the middle of the bottom face of each object, f64[m, 4]."""
        x, y, yaw = pose_at(self.traffic.motions, time_s).T
        return np.stack([x, y, self.ground.height(x, y), yaw], axis=1)

    def solids(self, time_s: float) -> np.ndarray:
        objects = place_solids(self.parts, self.object_poses(time_s)[self.parts["owner"]])
        return np.concatenate([self.scenery, objects])

    def ego_pose(self, time_s: float) -> np.ndarray:
        """Pose of the ego vehicle (x forward, z normal to the ground) in the street frame, f64[4, 4]."""
        x, y, yaw = pose_at(self.ego, time_s)[0]
        a, b, _ = max(self.ground.planes, key=lambda p: p[0] * x + p[1] * y + p[2])
        up = np.array([-a, -b, 1]) / np.sqrt(1 + a * a + b * b)
        forward = np.array([np.cos(yaw), np.sin(yaw), a * np.cos(yaw) + b * np.sin(yaw)])
        forward /= np.linalg.norm(forward)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
        pose[:3, 3] = x, y, self.ground.slope_height(x, y)
        return pose


def sample_world(
    rng: Generator,
    *,
    reach_m: float,
    beyond_m: float,
    duration_s: float,
    labels: np.ndarray,
    level: bool = False,
    fused: bool = False,
    fast_traffic: bool = False,
    streets: Streets = PLAIN,
) -> World:
    """Sample a world.

    Args:
        reach_m: each object or its row begins beside a place of a street within this distance of the ego vehicle.
        beyond_m: extent of the scenery around the path of the ego vehicle.
        labels: i32[m], classes of the objects; objects without room are omitted.
        level: ground without slopes.
        fused: the world is scanned at its end only, as a few fused sweeps. Objects are within reach then.
        fast_traffic: the ego vehicle drives straight at 10 to 20 m/s, all lanes flow, and nearly all objects that
            can move do.
    """
    shapes, grounds, surroundings, unit = rng.spawn(4)
    ground = _uneven(grounds, _sample_ground(rng, level), streets)
    ego = _sample_ego(rng, ground, duration_s, fast_traffic)
    path = pose_at(ego, np.arange(0, duration_s + 0.1, 0.5))[:, :2]
    around = {"low": path.min(axis=0), "high": path.max(axis=0), "beyond_m": beyond_m}
    scenery = sample_scenery(rng, surroundings, ground, **around, streets=streets)
    center, half, yaw = scenery["center"], scenery["half"], scenery["yaw"]
    standing = center[:, 2] - half[:, 2] < 2 + ground.height(*center[:, :2].T)
    traffic = sample_traffic(
        rng,
        ground,
        ego,
        labels=sorted(labels, key=lambda k: -np.prod(OBJECT_MODELS[NUSCENES_CLASSES[k]][0].size_m)),
        occupied=np.concatenate([center[:, :2], 2 * half[:, :2], yaw[:, None]], axis=1)[standing],
        reach_m=reach_m,
        duration_s=duration_s,
        fused=fused,
        fast_traffic=fast_traffic,
        streets=streets,
    )
    parts, surfaces = [np.zeros(0, SOLID)], shapes.spawn(1)[0]
    gloss = streets.gloss * surfaces.random()
    for index, (model, size) in enumerate(zip(traffic.models, traffic.sizes, strict=True)):
        parts.append(object_solids(model, size, sample_paint(rng, model)))
        if streets.shape:
            vary_shape(shapes, parts[-1], size, streets.shape)
        if streets.gloss:
            polish(surfaces, model, parts[-1], gloss)
        if streets.patchwork:
            parts[-1]["albedo"] *= np.exp(streets.patchwork * surfaces.standard_normal(len(parts[-1])))
        parts[-1]["owner"] = index
    return World(ground, scenery, traffic, np.concatenate(parts), ego, streets, int(unit.integers(2**63)))


def class_shares(power: float) -> np.ndarray:
    """Class frequencies, f64[10]: ``power`` 1 gives the frequencies of nuScenes, 0 equal frequencies."""
    shares = _SHARES**power
    return shares / shares.sum()


def sample_labels(rng: Generator, number: int) -> np.ndarray:
    """Sample the classes of a street's objects, i32: one of each class, the rest with nuScenes frequencies."""
    more = rng.choice(len(NUSCENES_CLASSES), max(number - len(NUSCENES_CLASSES), 0), p=class_shares(1.0))
    return np.concatenate([np.arange(len(NUSCENES_CLASSES)), more]).astype(np.int32)[:number]


def _sample_ground(rng: Generator, level: bool) -> Ground:
    lanes, across = rng.integers(1, 3, 2)
    slope = 0.0 if level else 1.0
    a, b = slope * rng.normal(0, 0.012, 2)
    ahead, behind, beside = slope * rng.uniform(0, 0.02, 3)
    planes = np.array(
        [
            [a, b, 0],
            [a + ahead, b, -ahead * rng.uniform(30, 90)],
            [a - behind, b, -behind * rng.uniform(30, 90)],
            [a, b + beside, -beside * rng.uniform(15, 40)],
            [a, b - beside, -beside * rng.uniform(15, 40)],
        ]
    )
    return Ground(
        planes[:1] if level else planes,
        half_width=lanes * LANE_M + 2.5,
        crossing_x=rng.uniform(20, 45),
        crossing_half_width=across * LANE_M + 2.5,
        kerb=0.13,
        pavement=rng.uniform(2.5, 4.5),
        brightness=(rng.uniform(0.03, 0.08), rng.uniform(0.07, 0.16), rng.uniform(0.05, 0.14)),
    )


def _uneven(rng: Generator, ground: Ground, streets: Streets) -> Ground:
    """Add the undulations, crowns, kerbs and shading of the streets to the ground."""
    height, shade = rng.spawn(2)
    if streets.relief_m:
        deviation = streets.relief_m * np.exp(0.5 * rng.standard_normal())
        ground = dataclasses.replace(ground, relief=sample_relief(height, deviation, 2.2))
    if streets.crown_m:
        crown, kerb = streets.crown_m * rng.random(), rng.choice([0.03, 0.1, 0.13, 0.16, 0.2])
        ground = dataclasses.replace(ground, crown=float(crown), kerb=float(kerb))
    if streets.shading:
        ground = dataclasses.replace(ground, shading=sample_relief(shade, streets.shading, 1.0))
    return ground


def _sample_ego(rng: Generator, ground: Ground, duration_s: float, fast_traffic: bool) -> np.ndarray:
    y = -LANE_M / 2 if rng.random() < 0.6 else -(ground.half_width - 2.5 - LANE_M / 2)
    if fast_traffic:
        return make_motion(y=y, speed=rng.uniform(10, 20))
    manoeuvre, speed = rng.choice(_MANOEUVRES), rng.uniform(4, 11)
    if manoeuvre == "stopped":
        return make_motion(y=y)
    if manoeuvre == "braking":
        return make_motion(y=y, speed=speed, acceleration=-speed / max(0.6 * duration_s, 2.0))
    if manoeuvre == "starting":
        return make_motion(y=y, acceleration=rng.uniform(0.4, 0.9))
    if manoeuvre == "straight":
        return make_motion(y=y, speed=speed)
    side = 1 if manoeuvre == "left" else -1
    radius = rng.uniform(10, 14) if manoeuvre == "left" else rng.uniform(6, 9)
    bend = {"straight": ground.crossing_x + side * LANE_M / 2 - radius, "curvature": side / radius}
    return make_motion(y=y, speed=rng.uniform(4, 6.5), turn=side * np.pi / 2, **bend)
