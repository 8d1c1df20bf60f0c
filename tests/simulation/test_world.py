"""Check the simulated world: motion against integration, traffic, and sweeps of constructed worlds."""

import functools
import itertools

import numpy as np
import oracles
import pytest
import shapely
from numpy.random import default_rng
from scipy.integrate import cumulative_trapezoid
from shapely import STRtree

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.sensors import TINY, Sensor, even_inclinations, sector
from fcos_lidar_jax.simulation.frames import scan_sweeps
from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.lidar import SWEEP_S, Scan, sample_mount, scan
from fcos_lidar_jax.simulation.motion import MOTION, make_motion, pose_at, travelled, velocity_at
from fcos_lidar_jax.simulation.nuscenes_tables import attribute_of, visibility_of
from fcos_lidar_jax.simulation.objects import OBJECT_MODELS, object_solids, sample_size
from fcos_lidar_jax.simulation.solids import BOX, SOLID, corners, make_solids
from fcos_lidar_jax.simulation.traffic import EGO_MIDDLE_M, EGO_SIZE_M, Traffic, _Occupancy
from fcos_lidar_jax.simulation.world import World, sample_labels, sample_world

FLAT = Ground(np.zeros((1, 3)), 300, 900, 7, 0.0, 3, (0.3, 0.3, 0.3))
FINE = Sensor("fine", even_inclinations(-6, 2, 8), 2048, limit_xy_m=60)
MOTIONS = {
    "still": make_motion(x=3, y=-1, yaw=2),
    "straight": make_motion(speed=7, yaw=-0.4),
    "braking to rest": make_motion(speed=6, acceleration=-2, yaw=1),
    "starting": make_motion(acceleration=0.9),
    "left": make_motion(x=-5, speed=5, straight=8, curvature=1 / 12, turn=np.pi / 2),
    "right": make_motion(speed=6, acceleration=-0.5, straight=5, curvature=-1 / 7, turn=-np.pi / 2, yaw=0.3),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_positions_match_the_integral_of_the_velocity(motion):
    m, times = motion[0], np.linspace(0, 8, 8001)
    integral = functools.partial(cumulative_trapezoid, x=times, initial=0)
    end = m["straight"] + (m["turn"] / m["curvature"] if m["curvature"] else 0)
    speed = np.maximum(m["speed"] + m["acceleration"] * times, 0.0)
    way = integral(speed)
    yaw = m["yaw"] + integral(speed * m["curvature"] * ((m["straight"] < way) & (way < end)))
    expected = np.stack([m["x"] + integral(speed * np.cos(yaw)), m["y"] + integral(speed * np.sin(yaw)), yaw], 1)
    found = pose_at(motion, times)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=0.03)
    np.testing.assert_allclose(found[:, 2], expected[:, 2], atol=4e-3)
    step = 1e-5
    slope = (pose_at(motion, times + step) - found)[:, :2] / step
    np.testing.assert_allclose(velocity_at(motion, times), slope, atol=1e-3)
    assert (travelled(motion, times)[1] >= 0).all()


def test_the_shortcut_for_straight_motions_is_bit_identical():
    """Straight motions only are computed by a shortcut, unlike straight motions together with a bend."""
    times = np.linspace(0, 8, 50)
    for name in ("still", "straight", "braking to rest", "starting"):
        both = np.concatenate([MOTIONS[name], MOTIONS["left"]])[:, None]
        np.testing.assert_array_equal(pose_at(MOTIONS[name], times), pose_at(both, times)[0], err_msg=name)


def test_room_for_objects_matches_shapely():
    rng, times, clearance = default_rng(0), np.linspace(0, 1, 6), 0.3

    def moving(number):
        start = np.concatenate([rng.uniform(-15, 15, (number, 2)), rng.uniform(-4, 4, (number, 1))], axis=1)
        poses = start[:, None] + times[:, None] * rng.uniform(-8, 8, (number, 1, 3))
        return poses, rng.uniform(0.5, 6, (number, 3))

    def shapes(poses, sizes):
        boxes = np.zeros((*poses.shape[:2], 7))
        boxes[..., [0, 1, 6]], boxes[..., 3:5] = poses, sizes[:, None, :2]
        return oracles.rectangles(boxes.reshape(-1, 7)).reshape(poses.shape[:2])

    (standing, sizes), (added, added_sizes) = moving(4), moving(4)
    occupied = np.concatenate([standing[:, 0, :2], sizes[:, :2], standing[:, 0, 2:]], axis=1)
    occupancy = _Occupancy(times, occupied)
    for poses, size in zip(added, added_sizes, strict=True):
        occupancy.add(poses, size)
    stay = np.repeat(standing[:, :1], len(times), axis=1)
    there = np.concatenate([shapes(stay, sizes), shapes(added, added_sizes)])
    found = []
    for pose, size in zip(*moving(500), strict=True):
        distance = shapely.distance(shapes(pose[None], size[None]), there).min()
        if distance == 0 or distance > np.sqrt(2) * clearance:  # between these limits it depends on the corners
            found.append(occupancy.has_room(pose, size, clearance))
            assert found[-1] == (distance > 0), distance
    assert 50 < np.sum(found) < len(found) - 50


@pytest.fixture(scope="module")
def worlds() -> list[World]:
    options = {"reach_m": 60, "beyond_m": 80, "duration_s": 6.0}
    return [sample_world(default_rng(s), labels=sample_labels(default_rng(s), 70), **options) for s in range(5)]


@pytest.fixture(scope="module")
def fast_worlds() -> list[World]:
    """Worlds of ten sweeps, of which the last four have a crossing within reach."""
    options = {"beyond_m": 20, "duration_s": 0.45, "fused": True, "fast_traffic": True}
    near, far = ({"reach_m": m, "labels": np.tile(np.arange(10), n), **options} for m, n in ((12, 2), (50, 6)))
    return [sample_world(default_rng(seed), **(near if seed < 10 else far)) for seed in range(14)]


def test_objects_never_touch_each_other_or_the_ego_vehicle(worlds, fast_worlds):
    """Fast objects are also checked between sweeps."""
    slow = itertools.product(worlds, (0.0, 2.5, 6.0))
    for world, time_s in [*slow, *itertools.product(fast_worlds, np.linspace(0, 0.45, 24))]:
        boxes = np.zeros((len(world.traffic.labels) + 1, 7))
        boxes[:-1, [0, 1, 6]] = world.object_poses(time_s)[:, [0, 1, 3]]
        boxes[:-1, 3:5] = world.traffic.sizes[:, :2]
        x, y, yaw = pose_at(world.ego, time_s)[0]
        boxes[-1] = x + EGO_MIDDLE_M * np.cos(yaw), y + EGO_MIDDLE_M * np.sin(yaw), 0, *EGO_SIZE_M, 0, yaw
        shapes = oracles.rectangles(boxes)
        one, other = STRtree(shapes).query(shapes, predicate="intersects")
        assert (one == other).all(), time_s


def test_fast_traffic_flows_in_all_lanes_and_objects_are_near_at_the_end(fast_worlds):
    speeds = np.array([np.linalg.norm(pose_at(w.ego, 0.45) - pose_at(w.ego, 0.0)) / 0.45 for w in fast_worlds])
    assert ((speeds >= 10) & (speeds <= 20)).all()
    assert np.ptp(speeds) > 4
    crossing = 0
    for world in fast_worlds:
        moves = world.traffic.motions
        assert pose_at(world.ego, 9.0)[0, 1] == world.ego["y"][0]
        fast = moves[np.isin(world.traffic.labels, [0, 1, 2, 3, 4, 6]) & (moves["speed"] > 0)]
        assert ((fast["speed"] >= 8) & (fast["speed"] <= 20)).all()
        assert (fast["acceleration"] == 0).all()
        crossing += (np.abs(np.sin(fast["yaw"])) > 0.9).sum()
        singles = world.object_poses(0.45)[~np.isin(world.traffic.labels, [0, 3, 8, 9])]  # the others form rows
        away = np.hypot(*(singles[:, :2] - pose_at(world.ego, 0.45)[0, :2]).T)
        assert (away < (12 if len(world.traffic.labels) <= 20 else 50) + 30).all()
    assert crossing > 5


def test_worlds_contain_all_classes_moving_and_parked_cars_and_all_manoeuvres(worlds):
    for world in worlds:
        assert len(np.unique(world.traffic.labels)) >= 9
    cars = np.concatenate([w.traffic.motions["speed"][w.traffic.labels == 0] for w in worlds])
    assert min((cars > 2).mean(), (cars == 0).mean()) > 0.1
    none = {"reach_m": 9, "beyond_m": 9, "duration_s": 2.0, "labels": np.zeros(0, int)}
    egos = np.concatenate([sample_world(default_rng(seed), **none).ego for seed in range(40)])
    kinds = [egos["turn"] > 0, egos["turn"] < 0, (egos["speed"] == 0) & (egos["acceleration"] == 0)]
    kinds += [egos["acceleration"] > 0, egos["acceleration"] < 0]
    assert all(kind.any() for kind in kinds)
    slopes = np.concatenate([w.ground.planes[:, :2].ravel() for w in worlds])
    assert np.abs(slopes).max() > 0.005


@pytest.mark.parametrize("name", OBJECT_MODELS)
def test_solids_stay_within_annotated_boxes(name):
    """The exception is a fence on a barrier, which real annotations exclude, too."""
    rng = default_rng(0)
    for model in OBJECT_MODELS[name]:
        for _ in range(20):
            size = sample_size(rng, model)
            solids = object_solids(model, size, 0.2)
            ends = corners(solids[solids["density"] != 40.0])
            reach = np.array([0.62, 0.62, 1]) * size + 1e-9  # corners are of cuboids that enclose leaning solids
            assert (np.abs(ends[..., :2]).max(axis=(0, 1)) <= reach[:2]).all(), size
            assert ends[..., 2].min() >= -1e-9
            assert 0.85 * size[2] < ends[..., 2].max() <= reach[2], size


def test_attributes_follow_class_and_speed():
    for name, speed, expected in (
        ("car", 0.3, "vehicle.moving"),
        ("bus", 0.0, "vehicle.stopped"),
        ("truck", 0.1, "vehicle.stopped"),
        ("pedestrian", 1.0, "pedestrian.moving"),
        ("pedestrian", 0.0, "pedestrian.standing"),
        ("bicycle", 3.0, "cycle.with_rider"),
        ("barrier", 0.0, None),
        ("traffic_cone", 0.0, None),
    ):
        assert attribute_of(name, speed, rider=speed > 2, parked=False) == expected
    assert {attribute_of(name, 0.0, rider=False, parked=True) for name in ("car", "truck")} == {"vehicle.parked"}


def made_by_hand(ego, objects=(), scenery=None) -> World:
    """A flat world of cuboids; ``objects`` are (x, y, speed, size) with heading +x."""
    nothing = np.zeros(0, SOLID)
    number, sizes = len(objects), np.array([size for *_, size in objects], float).reshape(-1, 3)
    parts = [make_solids(BOX, [0, 0, size[2] / 2], size / 2, owner=k, albedo=0.8) for k, size in enumerate(sizes)]
    motions = [make_motion(x=x, y=y, speed=speed) for x, y, speed, _ in objects]
    models, motions = OBJECT_MODELS["car"][:1] * number, np.concatenate([np.zeros(0, MOTION), *motions])
    traffic = Traffic(np.zeros(number, np.int32), models, sizes, motions, np.zeros(number, bool))
    return World(FLAT, nothing if scenery is None else scenery, traffic, np.concatenate([nothing, *parts]), ego)


WALL = make_solids(BOX, [10, 30, 4], [60, 0.5, 6], albedo=0.8)
"""The face of the wall is at y = 29.5 m."""
LEVEL = sample_mount(default_rng(0), FINE, level=True)


def scan_fine(world, time_s=0.0, seed=0, **options) -> Scan:
    return scan(world, FINE, LEVEL, time_s, default_rng(seed), **options)


def assert_wall_is_sharp(points, least=0):
    on_wall = points[(points[:, 1] > 28) & (points[:, 2] > 0.5), 1]
    assert len(on_wall) > least
    assert abs(on_wall.mean() - 29.5) < 0.005
    assert np.abs(on_wall - 29.5).max() < 0.08


def test_fused_sweeps_align_static_objects_and_trail_behind_moving_objects():
    ego = make_motion(speed=14.0, straight=4, curvature=1 / 30, turn=np.pi / 2)
    world = made_by_hand(ego, [(8, 12, 8.0, (4, 2, 3))], WALL)
    points, _ = scan_sweeps(world, FINE, LEVEL, 1.0, default_rng(7), CloudReading(10, "none"))
    lags = (np.arange(10) * SWEEP_S).astype(np.float32)
    np.testing.assert_array_equal(points[np.r_[True, np.diff(points[:, 4]) != 0], 4], lags)
    current = scan_fine(world, 1.0, 7)
    np.testing.assert_array_equal(points[points[:, 4] == 0, :4], current.points[current.returned, :4])
    now = world.ego_pose(1.0) @ LEVEL
    off = []
    for age, lag in enumerate(lags):
        there = points[points[:, 4] == lag, :3].astype(float) @ now[:3, :3].T + now[:3, 3]
        assert_wall_is_sharp(there, least=500)
        x = there[(there[:, 2] > 0.5) & (there[:, 1] < 14) & (there[:, 1] > 10), 0]
        # The tolerance covers ray spacing and noise.
        assert (x.min() + x.max()) / 2 == pytest.approx(8 + 8 * (1 - lag), abs=0.12)
        then = world.ego_pose(1.0 - age * SWEEP_S) @ LEVEL
        own = (there - then[:3, 3]) @ then[:3, :3]
        unmoved = own @ now[:3, :3].T + now[:3, 3]  # result of a fusion without poses
        off.append(np.median(np.abs(unmoved[there[:, 1] > 28] - there[there[:, 1] > 28]).max(axis=1)))
    assert off[0] < 1e-3
    assert off[-1] > 4  # metres; shows the effect of the poses


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_a_rolling_shutter_shifts_only_moving_objects(speed):
    starts = (-12, 0, 12)
    world = made_by_hand(make_motion(speed=speed), [(x, -9.0, 12.0, (4, 2, 3)) for x in starts], WALL)
    found, pose = [], world.ego_pose(1.0) @ LEVEL
    for rolling in (False, True):
        sweep = scan_fine(world, 1.0, 5, rolling_shutter=rolling)
        points = sweep.points[sweep.returned, :3].astype(float) @ pose[:3, :3].T + pose[:3, 3]
        assert_wall_is_sharp(points)
        objects = points[(points[:, 1] < -7) & (points[:, 2] > 0.5)]
        found.append([objects[np.abs(objects[:, 0] - x - 12) < 4, 0].mean() for x in starts])
    still, rolled = np.array(found)
    shift = still - rolled  # shift of the objects in metres when the beam passes
    assert ((shift > -0.05) & (shift < 12 * SWEEP_S + 0.05)).all(), shift
    assert np.ptp(shift) > 0.05  # the beam passes the objects one after another
    if speed == 0:
        assert shift.max() > 0.1


def test_the_seen_share_is_the_share_of_unblocked_rays():
    objects = [(20, 0, 0, (0.2, 8, 3)), (10, 1, 0, (0.2, 2, 3)), (-15, 0, 0, (2, 2, 2))]
    world = made_by_hand(make_motion(), objects)
    share = scan_fine(world).seen_share
    eye = (world.ego_pose(0.0) @ LEVEL)[:3, 3]
    wide, hidden = 2 * np.arctan2(4, 19.9 - eye[0]), np.arctan2(2, 9.9 - eye[0])
    # The near object blocks all rays to the far object within its own azimuth span.
    assert share[0] == pytest.approx(1 - hidden / wide, abs=0.04)
    assert share[1] == share[2] == 1
    assert [visibility_of(s) for s in share] == ["2", "4", "4"]


def test_intensity_follows_material_and_angle():
    means = {}
    for name, albedo, yaw in (("bright", 0.5, 0.0), ("dark", 0.1, 0.0), ("oblique", 0.5, 1.2)):
        plate = make_solids(BOX, [12, 0, 2], [0.05, 1, 3], albedo=albedo, yaw=yaw)
        sweep = scan_fine(made_by_hand(make_motion(), scenery=plate))
        local = sweep.points[sweep.returned]
        means[name] = local[(local[:, 2] > -1) & (np.linalg.norm(local[:, :3], axis=1) > 5), 3].mean()
    assert means["bright"] / means["dark"] == pytest.approx(5, rel=0.15)
    assert means["oblique"] < 0.85 * means["bright"]


def test_points_without_return_surround_the_sensor_and_points_have_laser_numbers():
    mount = sample_mount(default_rng(0), TINY, level=True)
    sweep = scan(made_by_hand(make_motion()), TINY, mount, 0.0, default_rng(0))
    lost = sweep.points[~sweep.returned]
    assert len(lost) > 100
    assert np.abs(lost[:, :3]).max() < 0.15
    assert sweep.points.shape == (TINY.num_rows * TINY.num_columns, 5)
    np.testing.assert_array_equal(sweep.points[:, 4], np.tile(np.arange(TINY.num_rows), TINY.num_columns))
    back = sweep.points[sweep.returned]
    slope = np.arctan2(back[:, 2], np.hypot(back[:, 0], back[:, 1]))
    expected = np.array(TINY.inclinations_rad)[::-1][back[:, 4].astype(int)]
    np.testing.assert_allclose(slope, expected, atol=1e-4)


@pytest.mark.parametrize("middle", [np.pi / 2, -3.0])
def test_a_sector_is_scanned_at_its_part_of_the_turn(middle):
    part = sector(TINY, middle, 64)
    world, mount = made_by_hand(make_motion()), sample_mount(default_rng(0), TINY, level=True)
    found, whole = (
        scan(world, sensor, mount, 0.0, default_rng(0), rolling_shutter=True) for sensor in (part, TINY)
    )
    assert found.points.shape == (TINY.num_rows * 64, 5)
    back = found.points[found.returned]
    behind = (part.first_azimuth_rad - np.arctan2(back[:, 1], back[:, 0]) + 0.1) % (2 * np.pi)
    assert behind.max() < 0.1 + (64 + 3) * part.column_rad
    assert len(back) > 400
    assert len(whole.points) == 4 * len(found.points)
