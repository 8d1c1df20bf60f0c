"""Check the randomisations of varied streets, and that frames are unchanged."""

import dataclasses

import numpy as np
import pytest
from numpy.random import default_rng

from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY, sector
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames, city_frames
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.simulation.ground import Ground, Relief, Side, sample_relief
from fcos_lidar_jax.simulation.lidar import Scan, sample_mount, scan
from fcos_lidar_jax.simulation.motion import MOTION, make_motion
from fcos_lidar_jax.simulation.objects import (
    CLUTTER_MODELS,
    OBJECT_MODELS,
    object_solids,
    polish,
    sample_size,
    vary_shape,
)
from fcos_lidar_jax.simulation.scenery import sample_side
from fcos_lidar_jax.simulation.solids import BOX, SOLID, WHEEL, corners, make_solids
from fcos_lidar_jax.simulation.streets import CITY, PLAIN
from fcos_lidar_jax.simulation.traffic import Traffic
from fcos_lidar_jax.simulation.world import World, class_shares, sample_labels

SENSOR = NUSCENES_HDL32E
VARIED = dataclasses.replace(CITY, gloss=1.0, patchwork=0.4, walls=0.35, bends=0.03, depots=0.5)  # as for hdl32e
QUARTER = sector(SENSOR, np.pi / 2, 272)
FRAMES = {  # streets, sensor, number of objects; seed, number of points, objects by label, mean x, y, z, intensity
    "plain": (
        *(PLAIN, TINY, 12),
        (0, 3294, [1, 1, 1, 2, 1, 2, 0, 0, 0, 1], (0.92492, -0.79278, -1.12002, 18.78081)),
        (3, 3592, [1, 1, 2, 1, 1, 1, 2, 0, 0, 1], (-0.20851, -0.18856, -0.9564, 14.11192)),
    ),
    "city": (
        *(CITY, QUARTER, 60),
        (0, 4881, [5, 1, 0, 0, 0, 0, 0, 0, 0, 0], (0.40181, 13.56072, -0.5747, 16.08605)),
        (1, 5500, [12, 2, 0, 0, 0, 2, 0, 1, 0, 1], (-1.06243, 15.26934, -0.55856, 15.78145)),
    ),
    "varied": (
        *(VARIED, QUARTER, 120),
        (0, 5269, [7, 3, 0, 4, 0, 1, 0, 2, 0, 0], (1.50326, 11.15075, -0.83532, 13.67318)),
        (1, 5629, [19, 0, 1, 0, 0, 2, 0, 1, 1, 0], (-1.08263, 15.40816, -0.39658, 18.89714)),
        (2, 6256, [5, 4, 4, 0, 2, 0, 0, 0, 1, 6], (1.06828, 8.18378, -0.45203, 22.04748)),
        (3, 6110, [4, 5, 1, 1, 1, 0, 1, 1, 0, 4], (-0.69561, 9.36379, -0.29649, 14.20818)),
    ),
}
WAVE_M, HEIGHT_M, CROWN_M = 32.0, 0.08, 0.12
PLANE = np.array([[0.01, -0.02, -1.8]])
SIDES = pytest.mark.parametrize(("along", "side"), [(0, -1), (0, 1), (1, -1), (1, 1)])
STREET = Ground(np.zeros((1, 3)), 7, 900, 7, 0.13, 3, (0.3, 0.3, 0.3))


def wave(x):
    return HEIGHT_M * np.sin(2 * np.pi * x / WAVE_M)


def wavy_ground() -> Ground:
    """Ground of one plane with waves along x, a crowned street and kerbs."""
    grid = np.arange(256) * 0.5
    relief = Relief(np.tile(wave(grid)[:, None], (1, 256)).astype(np.float32))
    return Ground(PLANE, 6, 900, 5, 0.13, 3, (0.1, 0.2, 0.3), crown=CROWN_M, relief=relief)


def wavy_height(x, y):
    """Expected height of :func:`wavy_ground` in float64."""
    side = np.minimum(np.abs(y) / 6, 1)
    return 0.01 * x - 0.02 * y - 1.8 + wave(x) - CROWN_M * side**2 + 0.13 * (np.abs(y) >= 6)


def test_hits_on_uneven_ground_match_ray_marching():
    rng, eye = default_rng(1), np.array([0.3, -0.4, 0.2])
    x, y = rng.uniform(-150, 150, (2, 2000))
    np.testing.assert_allclose(wavy_ground().height(x, y), wavy_height(x, y), atol=2e-4)
    azimuth, falling = rng.uniform(-np.pi, np.pi, 400), np.radians(rng.uniform(-30, 3, 400))
    d = np.stack([np.cos(falling) * np.cos(azimuth), np.cos(falling) * np.sin(azimuth), np.sin(falling)])
    found, cosine = wavy_ground().first_hits(d.astype(np.float32), eye)
    steps = np.linspace(1.2, 118, 40_000)
    for ray in range(400):
        path = eye[:, None] + d[:, ray : ray + 1] * steps / np.cos(falling[ray])
        under = np.flatnonzero(wavy_height(path[0], path[1]) > path[2])
        if not len(under):
            assert found[ray] > 100
            continue
        # A ray that grazes a crest may end on either side of it.
        end = eye + d[:, ray].astype(float) * found[ray]
        clear = (path[2] - wavy_height(path[0], path[1]))[: under[0]]
        assert abs(end[2] - wavy_height(*end[:2])) < 0.02 or abs(abs(end[1]) - 6) < 0.05
        if len(clear) and clear[: int(0.9 * len(clear))].min(initial=1) > 0.05:
            assert found[ray] == pytest.approx(steps[under[0]] / np.cos(falling[ray]), rel=0.02, abs=0.05)
    assert np.isfinite(found).mean() > 0.6
    assert ((cosine >= 0) & (cosine <= 1)).all()


def test_relief_is_periodic_with_given_deviation_and_decreasing_spectrum():
    field = sample_relief(default_rng(3), 0.05, 2.0)
    x, y = default_rng(0).uniform(-60, 60, (2, 500))
    np.testing.assert_allclose(field.at(x, y), field.at(x + 128, y - 256), atol=1e-4)
    assert field.values.std() == pytest.approx(0.05, rel=1e-3)
    power = np.abs(np.fft.fft(field.values, axis=0)).mean(axis=1)
    assert power[3:8].mean() > 10 * power[40:80].mean()


def empty_world(streets, *, seed=0, ground=STREET, scenery=None, speed=0.0) -> World:
    nothing = np.zeros(0, SOLID)
    traffic = Traffic(np.zeros(0, np.int32), (), np.zeros((0, 3)), np.zeros(0, MOTION), np.zeros(0, bool))
    there = nothing if scenery is None else scenery
    return World(ground, there, traffic, nothing, make_motion(speed=speed), streets, seed)


def scan_of(world, seed=0, level_mount=True, **options) -> Scan:
    mount = sample_mount(default_rng(seed), SENSOR, level=level_mount, streets=world.streets)
    return scan(world, SENSOR, mount, 0.0, default_rng(seed), **options)


def changed(**fields):
    return dataclasses.replace(PLAIN, **fields)


def by_laser(values: np.ndarray) -> np.ndarray:
    """Reshape values of a scan's rays to [columns, lasers, ...], lowest laser first."""
    return values.reshape(-1, SENSOR.num_rows, *values.shape[1:])


def test_the_mount_has_a_downward_pitch_and_a_random_height():
    streets = changed(pitch_rad=0.03, mount_m=0.05)
    mounts = [sample_mount(default_rng(s), SENSOR, streets=streets) for s in range(300)]
    ahead, heights = np.array([m[2, 1] for m in mounts]), np.array([m[2, 3] for m in mounts])
    assert ahead.mean() == pytest.approx(-0.03, abs=0.003)
    assert (heights.mean(), heights.std()) == pytest.approx((1.84, 0.05), abs=0.01)
    level_mounts = [sample_mount(default_rng(s), SENSOR, level=True, streets=CITY) for s in range(3)]
    assert all((m[:3, 2] == [0, 0, 1]).all() for m in level_mounts)


def test_the_ego_vehicle_blocks_the_same_rays_as_in_nuscenes():
    """The lowest unblocked beam is the first to the right, the eighth ahead and the eleventh behind."""
    sweep = scan_of(empty_world(changed(ego_outline=True)))
    points, returned = sweep.points.reshape(-1, 32, 5), by_laser(sweep.returned)
    azimuth = np.degrees(np.arctan2(points[:, 13, 0], points[:, 13, 1]))  # clockwise from straight ahead
    for towards, lowest in ((90, 0), (-104, 0), (0, 7), (176, 9.5)):
        there = np.abs((azimuth - towards + 180) % 360 - 180) < 2
        free = returned[there].any(axis=0)
        assert np.argmax(free) == pytest.approx(lowest, abs=1.01), towards
        assert not free[: int(lowest)].any()


def test_the_edges_of_bonnet_and_roof_return_some_rays():
    """In nuScenes, these are about 70 points ahead and 60 to 130 behind, in a line across, low and dark."""
    without, found = (
        scan_of(empty_world(changed(ego_outline=True, ego_edges=edges))).points[:, :4] for edges in (False, True)
    )
    near = [p[(np.hypot(p[:, 0], p[:, 1]) < 2.2) & (np.abs(p[:, 1]) > 0.9)] for p in (without, found)]
    assert len(near[0]) == 0
    ahead, behind = near[1][near[1][:, 1] > 0], near[1][near[1][:, 1] < 0]
    for edge, distance, half in ((ahead, (1.4, 1.75), 0.62), (behind, (1.0, 1.15), 0.35)):
        assert 30 < len(edge) < 140
        assert np.ptp(edge[:, 1]) < 0.1
        assert distance[0] - 0.05 < np.abs(edge[:, 1]).mean() < distance[1] + 0.05
        assert np.abs(edge[:, 0]).max() < half + 0.05
        assert edge[:, 2].max() < -0.2


def of_rings(streets, unit, seed) -> np.ndarray:
    """Mean intensity and range offset of the upper lasers on walls at 19 m on both sides."""
    walls = make_solids(BOX, [[0, 20, 3], [0, -20, 3]], [30, 1, 9], albedo=0.3)
    points = by_laser(scan_of(empty_world(streets, seed=unit, scenery=walls), seed).points.astype(float))
    across = np.abs(points[..., 0])
    face = (across > 18) & (np.abs(points[..., 1]) < 8)
    range_m = np.linalg.norm(points[..., :3], axis=2)
    offset = range_m - 19 * range_m / np.maximum(across, 1e-3)
    rows = range(24, 30)
    return np.array([[v[:, k][face[:, k]].mean() for k in rows] for v in (points[..., 3], offset)])


def test_ring_gains_and_offsets_are_constant_within_a_drive():
    plain = changed(speckle=0.0, range_noise_m=0.0)
    ringed = dataclasses.replace(plain, ring_gain=0.4, ring_range_m=0.05)
    even = of_rings(plain, 5, 0)
    units = np.array([of_rings(ringed, unit, 0) for unit in range(5, 11)])
    assert np.ptp(even[0]) < 0.1 * even[0].mean()
    assert np.abs(even[1]).max() < 0.002
    assert np.log(units[:, 0] / even[0]).std() == pytest.approx(0.4, rel=0.4)
    assert units[:, 1].std() == pytest.approx(0.05, rel=0.4)
    again = of_rings(ringed, 5, 1)
    np.testing.assert_allclose(again[0], units[0, 0], rtol=0.05)
    np.testing.assert_allclose(again[1], units[0, 1], atol=0.002)


def test_glossy_surfaces_lose_grazing_rays():
    """Walls at 19 m on both sides, whose rays hit at the angle of their azimuth from the normal."""
    albedo, gloss = 0.1, 0.8
    walls = make_solids(BOX, [[0, 20, 3], [0, -20, 3]], [90, 1, 9], albedo=albedo, gloss=gloss)
    plain = changed(speckle=0.0, range_noise_m=0.0)
    share, brightness = {}, {}
    for streets in (plain, dataclasses.replace(plain, gloss=1.0)):
        sweep = scan_of(empty_world(streets, scenery=walls))
        points, returned = by_laser(sweep.points.astype(float)), by_laser(sweep.returned)
        rows = slice(23, 26)  # nearly level rays
        angle = np.arctan2(np.abs(points[..., 1]), np.abs(points[..., 0]))
        column = np.ma.median(np.ma.array(angle, mask=~returned), axis=1).data  # of all rays of a column
        for degrees in (10, 40, 65):
            near = np.abs(np.degrees(column) - degrees) < 4
            share[streets.gloss, degrees] = returned[near, rows].mean()
            brightness[streets.gloss, degrees] = points[near, rows, 3][returned[near, rows]].mean()
    for degrees in (10, 40, 65):
        cosine = np.cos(np.radians(degrees))
        lost = gloss * (0.15 + 0.85 * (1 - cosine))
        strength = albedo * (1 - lost) * cosine / (0.19 / cosine) ** 2
        expected = (1 - lost) * (1 - 0.015) * (1 - np.exp(-strength / plain.faint))
        assert share[1.0, degrees] == pytest.approx(expected, abs=0.06)
        assert brightness[1.0, degrees] == pytest.approx((1 - lost) * brightness[0.0, degrees], rel=0.1)
    assert share[0.0, 65] > 0.9


def test_only_paint_and_glass_of_vehicles_are_glossy():
    vehicles = ("car", "truck", "bus", "trailer", "construction_vehicle")
    for name, models in OBJECT_MODELS.items():
        for model in models:
            solids = model.solids.copy()
            polish(default_rng(0), model, solids, 0.5)
            glass = solids["density"] == 0.5
            paint = solids["gloss"][model.painted].max(initial=0)
            assert (0 < paint <= 1) == (name in vehicles)
            np.testing.assert_allclose(solids["gloss"], paint * np.where(glass, 2.5, model.painted))


@pytest.mark.parametrize("name", OBJECT_MODELS)
def test_varied_shapes_keep_the_box_tight(name):
    rng = default_rng(1)
    for model in OBJECT_MODELS[name]:
        size = sample_size(rng, model, CITY.sizes)
        usual = object_solids(model, size, 0.2)
        straight = (usual["lean"] == 0) & (usual["taper"] <= 1).all(axis=1)
        varied = usual.copy()
        vary_shape(rng, varied, size, CITY.shape)
        before, after = corners(usual[straight]), corners(varied[straight])
        for end in (np.min, np.max):
            slack = 0.05 + 0.02 * size.max()
            np.testing.assert_allclose(end(after, axis=(0, 1)), end(before, axis=(0, 1)), atol=slack)
        assert (varied["half"] > 0).all()
        wheels = usual["kind"] == WHEEL
        for field in ("center", "half"):
            np.testing.assert_allclose(varied[field][wheels], usual[field][wheels])
        assert (wheels.all() or (varied["half"] != usual["half"]).any()) or len(usual) == 2


@pytest.mark.parametrize("place", CLUTTER_MODELS)
def test_clutter_stands_on_the_ground_within_its_size(place):
    for model in CLUTTER_MODELS[place]:
        size = np.array(model.size_m)
        solids = object_solids(model, size, 0.2)
        ends = corners(solids)
        assert ends[..., 2].min() < 0.1 * size[2], model.category
        assert 0.8 * size[2] < ends[..., 2].max() < 1.02 * size[2], model.category
        assert (np.abs(ends[..., :2]).max(axis=(0, 1)) <= 0.75 * size[:2] + 0.3).all(), model.category


@SIDES
def test_surroundings_are_beside_their_street_and_off_both_carriageways(along, side):
    ground = Ground(np.zeros((1, 3)), 7, 30, 6, 0.13, 3, (0.1, 0.1, 0.1))
    here = Side(ground, along, side, (-60.0, 80.0))
    found = np.concatenate([sample_side(default_rng(s), here, CITY, "city") for s in range(4)])
    assert len(found) > 200
    assert (found["owner"] == -1).all()
    low = found[(found["center"][:, 2] - found["half"][:, 2] < 2) & (found["density"] > 5)]
    beside, half = (low["center"][:, 1], 7) if along == 0 else (low["center"][:, 0] - 30, 6)
    assert (np.sign(beside) == side).all()
    assert (np.abs(beside) >= half - 0.5).all()


@SIDES
def test_walls_and_long_buildings_line_the_street(along, side):
    """They stand behind the pavement, and no part of them stands on a carriageway."""
    ground = Ground(np.array([[0.02, 0, -1.8]]), 7, 30, 6, 0.13, 3, (0.1, 0.1, 0.1))
    here, walled = Side(ground, along, side, (-60.0, 80.0)), changed(walls=1.0)
    lengths = {"wall": [], "building": []}
    for seed in range(12):
        found = sample_side(default_rng(seed), here, walled, "city")
        x, y = found["center"][:, :2].T
        beside, half = (y, 7) if along == 0 else (x - 30, 6)
        away = np.abs(beside) - half - 3  # behind the pavement
        wall = np.isclose(found["half"][:, 1], 1.5) & (found["half"][:, 0] < 0.5)
        ends = np.abs(beside) - found["half"][:, 0]
        assert (np.sign(beside) == side).all()
        assert (ends[wall] > half + 2.5).all()
        assert (away[wall] < 2.7).all()
        assert np.ptp(away[wall]) < 1e-6  # in line
        top = (found["center"][:, 2] + found["half"][:, 2] - ground.height(x, y))[wall]
        assert np.ptp(top) < 1e-6
        assert 0.5 < top[0] < 2.8
        bodies = found[(found["half"][:, 0] > 3) & (found["half"][:, 1] > 3)]
        edges = corners(bodies)[..., :2].reshape(-1, 2)
        assert not ground.on_road(*edges.T).any()
        lengths["wall"].append(3.0 * wall.sum())
        lengths["building"].append(2 * bodies["half"][:, 1].sum())
    assert all(30 < np.mean(each) < 120 for each in lengths.values())
    assert len(sample_side(default_rng(0), here, PLAIN, "city")) == 0


def test_city_frames_vary_in_density():
    frames = [city_frames(QUARTER, 10_000).frame(i) for i in range(8)]
    numbers = [len(frame.labels) for frame in frames]
    assert max(numbers) > 2 * min(numbers)
    shares = [frame.num_points.sum() / len(frame.points) for frame in frames]
    assert np.mean(shares) < 0.2  # most points are background; 3 to 10 % in nuScenes


def test_class_frequencies_match_the_shares():
    shares = class_shares(1.0)
    drawn = np.bincount(sample_labels(default_rng(0), 20_010), minlength=10) - 1
    np.testing.assert_allclose(drawn / drawn.sum(), shares, atol=0.02)
    flat = class_shares(0.5)
    np.testing.assert_allclose(flat[0] / flat[2], np.sqrt(shares[0] / shares[2]))


def test_streets_are_part_of_fingerprints():
    streets = PLAIN, CITY, dataclasses.replace(CITY, clutter=0.2)
    assert len({SimulatedFrames(TINY, 3, streets=own).fingerprint() for own in streets}) == 3


@pytest.mark.parametrize("streets", FRAMES)
def test_frames_are_unchanged(streets):
    """The shipped weights were trained on such frames, and studies compare their scores with earlier ones."""
    given, sensor, number, *rows = FRAMES[streets]
    options = {} if given is PLAIN else {"num_objects": number, "reach_m": 54.0}
    for seed, num_points, labels, mean in rows:
        frame = make_frame(seed, sensor, streets=given, **options)
        assert len(frame.points) == num_points
        assert np.bincount(frame.labels, minlength=10).tolist() == labels
        np.testing.assert_allclose(frame.points[:, :4].mean(axis=0), mean, atol=1e-3)
