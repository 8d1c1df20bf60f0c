"""A ray-cast LiDAR over a scene: nearest hit of every beam, with noise, dropout and intensity."""

import numpy as np

from fcos_lidar_jax.data.synthetic.world import GROUND_Z, Scene
from fcos_lidar_jax.sensors import Sensor

_GROUND_ALBEDO = 0.25
_RANGE_NOISE_M = 0.015
_DROPOUT = 0.03
_AZIMUTH_JITTER = 0.2
"""Of a column's width; below half, so that every ray stays in its column."""


def beam_directions(sensor: Sensor, azimuth_offset: np.ndarray | None = None) -> np.ndarray:
    """Unit vectors of all beams, f64[h, w, 3].

    Args:
        sensor: rows and columns.
        azimuth_offset: f64[w], turns each column by this part of its width.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> beam_directions(TINY).shape
    (16, 256, 3)
    """
    offset = np.zeros(sensor.num_columns) if azimuth_offset is None else azimuth_offset
    column = np.arange(sensor.num_columns) + 0.5 + offset
    azimuth = np.pi - 2 * np.pi * column / sensor.num_columns
    inclination = np.array(sensor.inclinations_rad)[:, None]
    return np.stack(
        [
            np.cos(inclination) * np.cos(azimuth),
            np.cos(inclination) * np.sin(azimuth),
            np.sin(inclination) * np.ones_like(azimuth),
        ],
        axis=-1,
    )


def cast_rays(directions: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Nearest hit of rays from the sensor.

    Args:
        directions: f64[h, w, 3], unit vectors; a column shares one azimuth, clockwise from pi.
        scene: what they hit.

    Returns:
        range f64[h, w], inf where nothing is hit, and the reflected strength f64[h, w]: albedo times the cosine
        of the angle of incidence.

    >>> scene = Scene(np.array([[5.0, 0, 0, 2, 2, 2, 0]]), np.ones(1), *[np.zeros((0, 5)), np.zeros(0)] * 1,
    ...               np.zeros((0, 9)), np.zeros(0, np.int32))
    >>> [float(v[0, 0]) for v in cast_rays(np.array([[[1.0, 0, 0]]]), scene)]
    [4.0, 1.0]
    """
    down = directions[..., 2] < -1e-9
    best = np.where(down, GROUND_Z / np.where(down, directions[..., 2], -1), np.inf)
    strength = np.where(down, -directions[..., 2] * _GROUND_ALBEDO, 0.0)
    azimuth = np.arctan2(directions[0, :, 1], directions[0, :, 0])
    solids = [
        (_hit_cuboid, scene.cuboids, scene.cuboid_albedo),
        (_hit_cylinder, scene.cylinders, scene.cylinder_albedo),
    ]
    for hit, rows, albedos in solids:
        for solid, albedo in zip(rows, albedos, strict=True):
            columns = _columns_towards(azimuth, solid, hit is _hit_cuboid)
            rays = directions[:, columns]
            reach, cosine = hit(rays, solid)
            nearer = reach < best[:, columns]
            best[:, columns] = np.where(nearer, reach, best[:, columns])
            strength[:, columns] = np.where(nearer, albedo * cosine, strength[:, columns])
    return best, strength


def _columns_towards(azimuth: np.ndarray, solid: np.ndarray, cuboid: bool) -> np.ndarray:
    """Columns whose rays can meet the solid's bounding circle."""
    distance = np.hypot(solid[0], solid[1])
    radius = np.hypot(solid[3], solid[4]) / 2 if cuboid else solid[2]
    if distance <= radius:
        return np.arange(len(azimuth))
    off = (azimuth - np.arctan2(solid[1], solid[0]) + np.pi) % (2 * np.pi) - np.pi
    return np.flatnonzero(np.abs(off) <= np.arcsin(radius / distance) + 1e-6)


def _hit_cuboid(rays: np.ndarray, cuboid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range of the entry into a cuboid and the cosine of incidence there."""
    x, y, z, l, w, h, yaw = cuboid
    cos, sin = np.cos(yaw), np.sin(yaw)
    origin = (-(cos * x + sin * y), -(cos * y - sin * x), -z)
    local = (
        cos * rays[..., 0] + sin * rays[..., 1],
        cos * rays[..., 1] - sin * rays[..., 0],
        rays[..., 2],
    )
    enter, leave = np.full(rays.shape[:2], -np.inf), np.full(rays.shape[:2], np.inf)
    cosine = np.zeros(rays.shape[:2])
    for start, step, half in zip(origin, local, (l / 2, w / 2, h / 2), strict=True):
        safe = np.where(np.abs(step) < 1e-12, 1e-12, step)
        first, second = (-half - start) / safe, (half - start) / safe
        near = np.minimum(first, second)
        cosine = np.where(near > enter, np.abs(step), cosine)
        enter, leave = np.maximum(enter, near), np.minimum(leave, np.maximum(first, second))
    return np.where((enter <= leave) & (enter > 0), enter, np.inf), cosine


def _hit_cylinder(rays: np.ndarray, cylinder: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range of the entry into an upright cylinder, through its side or its top, and the cosine there."""
    x, y, radius, low, high = cylinder
    flat = rays[..., 0] ** 2 + rays[..., 1] ** 2
    towards = rays[..., 0] * x + rays[..., 1] * y
    inside = towards**2 - flat * (x * x + y * y - radius**2)
    side = (towards - np.sqrt(np.maximum(inside, 0))) / flat
    height = side * rays[..., 2]
    meets_side = (inside > 0) & (side > 0) & (height >= low) & (height <= high)
    nx, ny = side * rays[..., 0] - x, side * rays[..., 1] - y
    side_cosine = np.abs(nx * rays[..., 0] + ny * rays[..., 1]) / radius
    down = np.where(rays[..., 2] < -1e-12, rays[..., 2], -1.0)
    top = high / down
    meets_top = (high < 0) & (rays[..., 2] < -1e-12)
    meets_top &= np.hypot(top * rays[..., 0] - x, top * rays[..., 1] - y) <= radius
    reach = np.minimum(np.where(meets_side, side, np.inf), np.where(meets_top, top, np.inf))
    return reach, np.where(meets_side & (side <= reach), side_cosine, -rays[..., 2])


def scan(scene: Scene, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """One sweep of a scene.

    Args:
        scene: relative to the sensor.
        sensor: whose beams.
        rng: noise and dropout.

    Returns:
        f32[n, c]: x, y, z in the frame of the points, intensity 0-255, time lag 0, and the row as laser number
        for sensors that need it.

    >>> from fcos_lidar_jax.data.synthetic.world import make_scene
    >>> from fcos_lidar_jax.sensors import TINY
    >>> scan(make_scene(0, reach_m=20.0), TINY, np.random.default_rng(0)).shape[1]
    5
    """
    offset = rng.uniform(-_AZIMUTH_JITTER, _AZIMUTH_JITTER, sensor.num_columns)
    directions = beam_directions(sensor, offset)
    range_m, strength = cast_rays(directions, scene)
    noisy = range_m + rng.normal(0, _RANGE_NOISE_M, range_m.shape)
    dropped = rng.random(range_m.shape) < _DROPOUT
    intensity = np.clip(255 * strength * rng.normal(1, 0.05, range_m.shape), 0, 255)
    seen = (range_m < 2 * sensor.limit_xy_m) & ~dropped
    xyz = directions[seen] * noisy[seen, None] + np.array(sensor.origin_m)
    columns = [xyz, intensity[seen, None], np.zeros((len(xyz), 1))]
    if sensor.row_source == "laser":
        columns.append(np.nonzero(seen)[0][:, None])
    return np.concatenate(columns, axis=1).astype(np.float32)
