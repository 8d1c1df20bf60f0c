"""A rotating LiDAR in the simulated world: rays, noise, dropout, intensity and file rows."""

import dataclasses
import itertools

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation.raycast import Fan, Hits, cast
from fcos_lidar_jax.simulation.solids import BOX, EGO, enclosing, make_solids, place_solids
from fcos_lidar_jax.simulation.streets import PLAIN, Streets
from fcos_lidar_jax.simulation.world import World

SWEEP_S = 0.05  # duration of a turn
_HEIGHT_M = 1.84  # height of the sensor above the ground
_FORWARD_M = 0.94  # distance of the sensor ahead of the rear axle
_SURPLUS = 1.0009  # the columns of a file span slightly more than a turn
_SECTORS = 10  # number of parts of a sweep with separate times, with rolling shutter
_TILT_RAD = 0.1  # upper bound of the sensor's tilt
_FARTHEST_M = 105.0
_RANGE_STEP_M = 0.002
_AHEAD_LOSS = 0.15  # share of the gloss that acts at perpendicular incidence
_MOST_LOST = 0.95
_LOST = 0.015  # share of strong returns that are lost
_NO_RETURN_NOISE_M = 0.02
_NO_RETURN_INTENSITY = 12.0  # mean intensity noise of rays without a return
_ROUGH_BESIDE = 3.0  # roughness of the ground beyond the pavements, relative to the streets
# Outline of the ego vehicle in nuScenes: lowest unblocked beam of an HDL-32E (0 is the lowest beam) every 8
# degrees, clockwise from 176 degrees left of straight ahead.
_OUTLINE = (
    *(10, 8, 7, 7, 5, 3, 2, 1, 0, 0, 0, 0.5, 2, 2, 2, 3.5, 5, 8, 6, 6, 7, 7, 8),
    *(7, 7, 6, 6, 8, 4.5, 3, 2, 1, 2, 0.5, 0, 0, 0, 0, 1, 3, 4.5, 6, 7, 8, 9.5),
)
_EDGES_M = (1.4, 1.0), (1.75, 1.15)  # least and greatest distances of (bonnet, roof) of nuScenes vehicles
_EDGE_HALVES_M = 0.62, 0.35
_EDGE_RETURNS = 0.5


@dataclasses.dataclass(frozen=True)
class Scan:
    """One turn, ray by ray: columns in order of time, each from the lowest laser up, as in nuScenes files."""

    points: np.ndarray  # f32[w * h, 5]: x, y, z in the point frame, intensity 0-255, laser (0 lowest)
    returned: np.ndarray  # bool[w * h]: False for rays without a return, whose points lie around the sensor
    seen_share: np.ndarray  # f64[m]: share of the rays towards each object that reach it; 0 without such rays


def sample_mount(rng: Generator, sensor: Sensor, *, level: bool = False, streets: Streets = PLAIN) -> np.ndarray:
    """Random pose of the point frame in the ego frame, f64[4, 4]: x right, y forward, slightly tilted."""
    tilt, roll, turn = (0.0, 0.0, 0.0) if level else np.clip(rng.normal(0, (0.016, 0.01, 0.005)), -0.04, 0.04)
    tilt -= 0.0 if level else streets.pitch_rad
    height = _HEIGHT_M + streets.mount_m * rng.spawn(1)[0].standard_normal()
    c, s = np.cos(turn - np.pi / 2), np.sin(turn - np.pi / 2)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    rotation = rotation @ np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    rotation = rotation @ np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = rotation, (_FORWARD_M, 0, height) - rotation @ np.array(sensor.origin_m)
    return mount


def scan(
    world: World,
    sensor: Sensor,
    mount: np.ndarray,
    time_s: float,
    rng: Generator,
    *,
    rolling_shutter: bool = False,
) -> Scan:
    """Simulate one turn of the sensor, which ends at a time; the points are in the point frame at this time.

    With ``rolling_shutter``, the ego vehicle and the objects move during the turn, and the points are compensated
    for the ego motion, as in nuScenes. Otherwise the turn takes no time.
    """
    now = world.ego_pose(time_s) @ mount
    begin = rng.uniform(-1, 1)
    rings = _sample_rings(world, sensor)
    edges = np.linspace(0, sensor.num_columns, (_SECTORS if rolling_shutter else 1) + 1).astype(int)
    # Number of columns of a full turn, and of the part of the turn before column 0.
    turn, before = float(sensor.num_columns), 0.0
    if sensor.azimuth_limits_rad is not None:
        turn = 2 * np.pi / sensor.column_rad
        before = (np.pi - sensor.first_azimuth_rad) / sensor.column_rad % turn
    sectors = []
    for first, last in itertools.pairwise(edges.tolist()):
        age = SWEEP_S * (1 - (before + (first + last) / 2) / turn % 1) if rolling_shutter else 0.0
        fan = _make_fan(sensor, rings, begin, first, last)
        sectors.append(_scan_sector(world, sensor, rings, fan, mount, max(time_s - age, 0.0), now, rng))
    points, returned, towards, seen = zip(*sectors, strict=True)
    return Scan(np.concatenate(points), np.concatenate(returned), sum(seen) / np.maximum(sum(towards), 1))


@dataclasses.dataclass(frozen=True)
class _Rings:
    """Properties of the lasers, from the highest down, that are constant over all sweeps of a world."""

    elevation_rad: np.ndarray  # f64[h]: offset of the inclination
    range_m: np.ndarray  # f32[h]: offset of the range
    gain: np.ndarray  # f32[h]: factor of the intensity
    faint: np.float32  # strength at which 63 % of the rays return
    edges_m: np.ndarray  # f64[2]: distances from the sensor to the edges of the bonnet ahead and the roof behind


def _sample_rings(world: World, sensor: Sensor) -> _Rings:
    streets, rng = world.streets, np.random.default_rng(world.unit_seed)
    elevation, offset, gain = rng.standard_normal((3, sensor.num_rows))
    return _Rings(
        streets.ring_elevation_rad * elevation,
        (streets.ring_range_m * offset).astype(np.float32),
        np.exp(streets.ring_gain * gain).astype(np.float32),
        np.float32(streets.faint * np.exp(streets.weather * rng.standard_normal())),
        rng.uniform(*_EDGES_M),
    )


def _scan_sector(
    world: World,
    sensor: Sensor,
    rings: _Rings,
    fan: Fan,
    mount: np.ndarray,
    time_s: float,
    now: np.ndarray,
    rng: Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, mask of returns, and the number of rays towards each object and of rays that reach it."""
    streets = world.streets
    pose = world.ego_pose(time_s) @ mount
    rotation, eye = pose[:3, :3], pose[:3, 3] + pose[:3, :3] @ np.array(sensor.origin_m)
    farthest = min(_FARTHEST_M, 2 * sensor.limit_xy_m)
    solids, hits = _first_hits(world, rings, fan, rotation, eye, farthest, time_s, rng)
    range_m, shape = hits.range_m, (fan.num_columns, sensor.num_rows)
    albedo, away = _reflect(world, rotation.astype(np.float32) @ fan.directions, eye, solids, hits, rng)
    # Nearly all strong rays return, but only some faint ones (far away or at a grazing angle).
    strength = albedo * hits.cosine / np.maximum(range_m / 100, np.float32(1e-3)) ** 2
    chance = (1 - away) * (1 - _LOST) * -np.expm1(-strength / rings.faint)
    returned = (rng.random(len(range_m), np.float32) < chance) & (range_m < farthest)

    range_m += np.tile(rings.range_m, fan.num_columns)
    local = _measure(fan.directions, range_m, returned, streets.range_noise_m, rng)
    local += np.array(sensor.origin_m, np.float32)[:, None]
    if not np.array_equal(pose, now):
        motion = np.linalg.inv(now) @ pose
        local = motion[:3, :3].astype(np.float32) @ local + motion[:3, 3:].astype(np.float32)
    intensity = rng.standard_exponential(len(albedo), np.float32) * np.float32(_NO_RETURN_INTENSITY)
    rays = np.flatnonzero(returned)
    speckle = np.exp(np.float32(streets.speckle) * rng.standard_normal(len(rays), np.float32))
    speckle *= rings.gain[rays % sensor.num_rows]
    intensity[rays] = 255 * albedo[rays] * (0.35 + 0.65 * hits.cosine[rays]) * speckle

    points = np.empty((*shape, 5), np.float32)
    points[:, ::-1, :3] = local.T.reshape(*shape, 3)
    points[:, ::-1, 3] = np.minimum(np.floor(intensity), 255).reshape(shape)
    points[..., 4] = np.arange(sensor.num_rows)
    num_objects = len(world.traffic.labels)
    reachable = np.bincount(hits.reachable // range_m.size, minlength=num_objects)
    owner = solids["owner"][hits.solid[hits.solid >= 0]]
    seen = np.bincount(owner[owner >= 0], minlength=num_objects)
    return points.reshape(-1, 5), returned.reshape(shape)[:, ::-1].ravel(), reachable, seen


def _first_hits(
    world: World,
    rings: _Rings,
    fan: Fan,
    rotation: np.ndarray,
    eye: np.ndarray,
    farthest: float,
    time_s: float,
    rng: Generator,
) -> tuple[np.ndarray, Hits]:
    """Solids in view, and the first hits of all rays on them, the ground and the ego vehicle."""
    solids = world.solids(time_s)
    if not world.streets.ego_outline:
        solids = np.concatenate([solids, _ego_solids(rotation, eye)])
    solids = _in_view(solids, fan, rotation, eye, farthest)
    hits = cast(fan, rotation, eye, solids, world.ground, rng)
    if world.streets.ego_outline:
        blocked = _behind_ego(fan)
        hits.range_m[blocked], hits.solid[blocked] = np.inf, -1
        if world.streets.ego_edges:
            edge, edge_range_m = _ego_edges(fan, blocked, rings.edges_m)
            edge &= rng.random(len(edge)) < _EDGE_RETURNS
            hits.range_m[edge] = edge_range_m[edge]
    return solids, hits


def _reflect(
    world: World, towards: np.ndarray, eye: np.ndarray, solids: np.ndarray, hits: Hits, rng: Generator
) -> tuple[np.ndarray, np.ndarray | np.float32]:
    """Albedo at the hits, and the share of the light that gloss reflects away; roughens the ground in place.

    ``towards`` are the directions of the rays f32[3, w * h] in the world.
    """
    streets, range_m = world.streets, hits.range_m
    albedo = np.append(solids["albedo"], 0.0).astype(np.float32)[hits.solid]
    ground = np.flatnonzero((hits.solid < 0) & np.isfinite(range_m))
    place = eye[:2, None] + towards[:2, ground] * range_m[ground]
    albedo[ground] = world.ground.albedo(*place)
    if streets.roughness_m:
        on_street = world.ground.on_road(place[0], place[1], world.ground.pavement)
        beside = np.where(on_street, 1, _ROUGH_BESIDE)
        rough = streets.roughness_m * beside * rng.standard_normal(len(ground))
        range_m[ground] += rough / np.maximum(hits.cosine[ground], 0.1)
    if world.ground.shading is not None:
        struck = np.flatnonzero(hits.solid >= 0)
        x, y, z = eye[:, None] + towards[:, struck] * range_m[struck]
        albedo[struck] *= np.exp(world.ground.shading.at(x + z, y + z))
    if not streets.gloss:
        return albedo, np.float32(0)
    gloss = np.append(solids["gloss"], 0.0).astype(np.float32)[hits.solid]
    away = np.minimum(gloss * (_AHEAD_LOSS + (1 - _AHEAD_LOSS) * (1 - hits.cosine)), np.float32(_MOST_LOST))
    return albedo * (1 - away), away


def _measure(
    d: np.ndarray, range_m: np.ndarray, returned: np.ndarray, noise_m: float, rng: Generator
) -> np.ndarray:
    """Measured points in the sensor's frame, f32[3, n]. Points without a return scatter around the origin."""
    noise = rng.standard_normal(len(range_m), np.float32) * np.float32(noise_m)
    noisy = np.round((range_m + noise) / np.float32(_RANGE_STEP_M)) * np.float32(_RANGE_STEP_M)
    points = d * np.where(returned, noisy, np.float32(0))
    lost = np.flatnonzero(~returned)
    points[:, lost] = rng.standard_normal((3, len(lost)), np.float32) * np.float32(_NO_RETURN_NOISE_M)
    return points


def _make_fan(sensor: Sensor, rings: _Rings, begin: float, first: int, last: int) -> Fan:
    rows = sensor.num_rows
    step = sensor.column_rad * _SURPLUS
    # The lasers fire one by one, alternating between the lower and the upper half.
    rising = np.arange(rows)
    slot = np.where(rising < rows // 2, 2 * rising, 2 * (rising - rows // 2) + 1)
    start = sensor.first_azimuth_rad - step * (0.1 + begin + first)
    inclinations = np.sort(np.array(sensor.inclinations_rad) + rings.elevation_rad)[::-1]
    return Fan(inclinations, last - first, start, step, delay=0.83 * slot[::-1] / rows)


def _behind_ego(fan: Fan) -> np.ndarray:
    """Mask of the rays that the ego vehicle blocks, bool[w * h]."""
    right, ahead, up = fan.directions
    clockwise = np.degrees(np.arctan2(right, ahead))
    lowest = np.interp(clockwise, np.linspace(-176, 176, len(_OUTLINE)), _OUTLINE, period=360)
    return np.degrees(np.arcsin(up)) < -30.67 + (lowest - 0.5) * 41.34 / 31


def _ego_edges(fan: Fan, blocked: np.ndarray, edges_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mask of the highest blocked ray of each column if it hits an edge, bool[w * h], and range of the edge."""
    right, ahead, _ = fan.directions
    high = blocked.reshape(fan.num_columns, -1).copy()
    high[:, 1:] &= ~high[:, :-1].copy()  # the highest ray comes first
    away = np.where(ahead > 0, edges_m[0], -edges_m[1]) / ahead
    across = np.abs(right * away)
    return high.ravel() & (across < np.where(ahead > 0, *_EDGE_HALVES_M)) & (np.abs(ahead) > 0.5), away


def _in_view(solids: np.ndarray, fan: Fan, rotation: np.ndarray, eye: np.ndarray, farthest: float) -> np.ndarray:
    """Solids within range, without those that certainly lie outside the fan."""
    radius = np.linalg.norm(enclosing(solids), axis=1)
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


def _ego_solids(rotation: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Roof, rack and bonnet of the ego vehicle below the sensor."""
    center = [[0, -0.45, -0.6], [0, 0.5, -0.34], [0, 1.75, -0.9]]
    half = [[0.54, 0.75, 0.22], [0.42, 0.13, 0.1], [0.6, 0.25, 0.23]]
    solids = make_solids(BOX, center, half, albedo=0.03, owner=EGO)
    return place_solids(solids, np.array([*eye, np.arctan2(rotation[1, 0], rotation[0, 0])]))
