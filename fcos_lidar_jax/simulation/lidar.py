"""A turning LiDAR in the simulated world: rays, noise, dropout, intensity, and the rows of its files."""

import dataclasses
import itertools

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation.raycast import Fan, Hits, cast
from fcos_lidar_jax.simulation.solids import BOX, OWN_CAR, make_solids, place_solids
from fcos_lidar_jax.simulation.world import World

SWEEP_S = 0.05
"""Duration of a turn."""
HEIGHT_M = 1.84
"""The sensor stands this far above the ground."""
FORWARD_M = 0.94
"""And this far before the car's rear axle."""
_SURPLUS = 1.0009
"""A file's columns span slightly more than a turn."""
_SECTORS = 10
"""Parts of a sweep with a time of their own, with rolling shutter."""
_TILT_RAD = 0.1
"""The sensor leans by less."""
_FARTHEST_M = 105.0
_RANGE_NOISE_M = 0.012
_RANGE_STEP_M = 0.002
_LOST = 0.015
"""Of strong returns."""
_FAINT = 0.07
"""Strength at which 63 % return."""
_NO_RETURN_NOISE_M = 0.02
_NO_RETURN_INTENSITY = 12.0
"""Mean of the noise that is written where nothing came back."""


@dataclasses.dataclass(frozen=True)
class Mount:
    """How a sensor sits on the car."""

    rotation: np.ndarray
    """f64[3, 3]: axes of the points' frame to the car's."""
    translation: np.ndarray
    """f64[3]: origin of the points' frame in the car's, metres."""


@dataclasses.dataclass(frozen=True)
class Scan:
    """One turn, ray by ray: columns in the order of time, in each the lowest laser first, as in nuScenes files."""

    points: np.ndarray
    """f32[w * h, 5]: x, y, z in the points' frame, intensity 0-255, laser (0 lowest)."""
    returned: np.ndarray
    """bool[w * h]: False where nothing came back; such points lie about the sensor."""
    seen_share: np.ndarray
    """f64[m]: share of the rays towards each object that nothing else stops; 0 where there is none."""


def sample_mount(rng: Generator, sensor: Sensor, *, level: bool = False) -> Mount:
    """A mount with y forward and x right, tilted by up to a degree or two unless ``level``."""
    tilt, roll, turn = (0.0, 0.0, 0.0) if level else np.clip(rng.normal(0, (0.016, 0.01, 0.005)), -0.04, 0.04)
    c, s = np.cos(turn - np.pi / 2), np.sin(turn - np.pi / 2)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    rotation = rotation @ np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    rotation = rotation @ np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    return Mount(rotation, np.array([FORWARD_M, 0, HEIGHT_M]) - rotation @ np.array(sensor.origin_m))


def sensor_pose(world: World, mount: Mount, time_s: float) -> np.ndarray:
    """The points' frame in the street's, f64[4, 4]."""
    carried = np.eye(4)
    carried[:3, :3], carried[:3, 3] = mount.rotation, mount.translation
    return world.ego_pose(time_s) @ carried


def scan(
    world: World, sensor: Sensor, mount: Mount, time_s: float, rng: Generator, *, rolling_shutter: bool = False
) -> Scan:
    """One turn of the sensor, which ends at a moment.

    Args:
        world: what there is.
        sensor: whose beams.
        mount: where it sits.
        time_s: moment of the sweep, and of the frame that its points are in.
        rng: noise and dropout.
        rolling_shutter: car and objects move during the turn; the points are then compensated for the car's
            motion, as nuScenes' are. Otherwise the turn takes no time.

    >>> from fcos_lidar_jax.simulation.world import sample_world
    >>> from fcos_lidar_jax.sensors import TINY
    >>> rng = np.random.default_rng(0)
    >>> world = sample_world(rng, reach_m=20, beyond_m=30, duration_s=0.0, labels=np.arange(10), level=True)
    >>> scan(world, TINY, sample_mount(rng, TINY, level=True), 0.0, rng).points.shape
    (4096, 5)
    """
    now = sensor_pose(world, mount, time_s)
    begin = rng.uniform(-1, 1)
    edges = np.linspace(0, sensor.num_columns, (_SECTORS if rolling_shutter else 1) + 1).astype(int)
    parts = []
    for first, last in itertools.pairwise(edges.tolist()):
        age = SWEEP_S * (1 - (first + last) / 2 / sensor.num_columns) if rolling_shutter else 0.0
        parts.append(_scan_sector(world, sensor, mount, max(time_s - age, 0.0), now, begin, (first, last), rng))
    towards, seen = (sum(p[i] for p in parts) for i in (2, 3))
    return Scan(
        np.concatenate([p[0] for p in parts]),
        np.concatenate([p[1] for p in parts]),
        seen / np.maximum(towards, 1),
    )


def _scan_sector(
    world: World,
    sensor: Sensor,
    mount: Mount,
    time_s: float,
    now: np.ndarray,
    begin: float,
    columns: tuple[int, int],
    rng: Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, which of them returned, and for every object the rays towards it and those that reach it."""
    pose = sensor_pose(world, mount, time_s)
    rotation, eye = pose[:3, :3], pose[:3, 3] + pose[:3, :3] @ np.array(sensor.origin_m)
    fan = _make_fan(sensor, begin, columns)
    everything = np.concatenate([world.solids(time_s), _own_car(rotation, eye)])
    solids = _in_view(everything, fan, rotation, eye, _farthest(sensor))
    hits = cast(fan, rotation, eye, solids, world.ground, rng)
    albedo = _albedo(world, solids, hits, rotation.astype(np.float32) @ fan.directions, eye)
    returned = _returned(hits, albedo, _farthest(sensor), rng)
    local = _measured(fan.directions, hits.range_m.ravel(), returned, rng)
    local += np.array(sensor.origin_m, np.float32)[:, None]
    if not np.array_equal(pose, now):
        motion = np.linalg.inv(now) @ pose
        local = motion[:3, :3].astype(np.float32) @ local + motion[:3, 3:].astype(np.float32)
    intensity = rng.standard_exponential(len(albedo), np.float32) * np.float32(_NO_RETURN_INTENSITY)
    back = np.flatnonzero(returned)
    speckle = np.exp(np.float32(0.3) * rng.standard_normal(len(back), np.float32))
    intensity[back] = 255 * albedo[back] * (0.35 + 0.65 * hits.cosine.ravel()[back]) * speckle
    points = np.empty((*hits.range_m.shape, 5), np.float32)
    points[:, ::-1, :3] = local.T.reshape(*hits.range_m.shape, 3)
    points[:, ::-1, 3] = np.minimum(np.floor(intensity), 255).reshape(hits.range_m.shape)
    points[..., 4] = np.arange(sensor.num_rows)
    number = len(world.traffic.labels)
    towards = np.bincount(hits.reachable // hits.range_m.size, minlength=number)
    struck = solids["owner"][hits.solid[hits.solid >= 0]]
    seen = np.bincount(struck[struck >= 0], minlength=number)
    return points.reshape(-1, 5), returned.reshape(hits.range_m.shape)[:, ::-1].ravel(), towards, seen


def _measured(d: np.ndarray, range_m: np.ndarray, returned: np.ndarray, rng: Generator) -> np.ndarray:
    """Measured points about the sensor, f32[3, n]; those without a return lie where it is, and a little off."""
    noise = rng.standard_normal(len(range_m), np.float32) * np.float32(_RANGE_NOISE_M)
    noisy = np.round((range_m + noise) / np.float32(_RANGE_STEP_M)) * np.float32(_RANGE_STEP_M)
    points = d * np.where(returned, noisy, np.float32(0))
    lost = np.flatnonzero(~returned)
    points[:, lost] = rng.standard_normal((3, len(lost)), np.float32) * np.float32(_NO_RETURN_NOISE_M)
    return points


def _farthest(sensor: Sensor) -> float:
    return min(_FARTHEST_M, 2 * sensor.limit_xy_m)


def _make_fan(sensor: Sensor, begin: float, columns: tuple[int, int]) -> Fan:
    rows = sensor.num_rows
    step = 2 * np.pi / sensor.num_columns * _SURPLUS
    # The lasers fire in turn, one of the lower half and one of the upper half alternately.
    rising = np.arange(rows)
    slot = np.where(rising < rows // 2, 2 * rising, 2 * (rising - rows // 2) + 1)
    delay = 0.83 * slot[::-1] / rows
    start = np.pi - step * (0.1 + begin + columns[0])
    return Fan(np.array(sensor.inclinations_rad), columns[1] - columns[0], start, step, delay)


def _in_view(solids: np.ndarray, fan: Fan, rotation: np.ndarray, eye: np.ndarray, farthest: float) -> np.ndarray:
    """The solids that are near enough, and not surely outside the fan."""
    radius = np.linalg.norm(solids["half"], axis=1) + np.abs(solids["lean"]) * solids["half"][:, 2]
    x, y = (solids["center"] - eye)[:, :2].T
    distance = np.hypot(x, y)
    kept = distance < farthest + radius
    half_span = fan.step * (fan.num_columns + 1) / 2
    if half_span < np.pi / 2:
        middle = fan.start - half_span + np.arctan2(rotation[1, 0], rotation[0, 0])
        away = np.abs(wrap_angle(np.arctan2(y, x) - middle))
        width = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-9), 1))
        kept &= (away < half_span + width + _TILT_RAD) | (distance <= radius)
    return solids[kept]


def _own_car(rotation: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Roof, rack and bonnet under the sensor."""
    center = [[0, -0.45, -0.6], [0, 0.5, -0.34], [0, 1.75, -0.9]]
    half = [[0.54, 0.75, 0.22], [0.42, 0.13, 0.1], [0.6, 0.25, 0.23]]
    solids = make_solids(BOX, center, half, albedo=(0.03, 0.03, 0.03), owner=OWN_CAR)
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return place_solids(solids, np.array([*eye, yaw]))


def _albedo(world: World, solids: np.ndarray, hits: Hits, towards: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Of what each ray meets, f32[n], 0 for nothing."""
    solid, range_m = hits.solid.ravel(), hits.range_m.ravel()
    albedo = np.append(solids["albedo"], 0.0).astype(np.float32)[solid]
    ground = np.flatnonzero((solid < 0) & np.isfinite(range_m))
    x, y = eye[:2, None] + towards[:2, ground] * range_m[ground]
    albedo[ground] = world.ground.albedo(x, y)
    return albedo


def _returned(hits: Hits, albedo: np.ndarray, farthest: float, rng: Generator) -> np.ndarray:
    """Which rays come back, bool[n]: strong ones nearly all, faint ones (far, grazing) in part."""
    range_m = hits.range_m.ravel()
    strength = albedo * hits.cosine.ravel() / np.maximum(range_m / 100, np.float32(1e-3)) ** 2
    returns = (1 - _LOST) * -np.expm1(-strength / np.float32(_FAINT))
    return (rng.random(len(range_m), np.float32) < returns) & (range_m < farthest)
