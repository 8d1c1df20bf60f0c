"""The simulated world: motion against integration, traffic, sweeps of worlds made by hand."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from shapely.geometry import Polygon

from fcos_lidar_jax.sensors import TINY, Sensor, even_inclinations
from fcos_lidar_jax.simulation.frames import scan_sweeps
from fcos_lidar_jax.simulation.ground import Ground
from fcos_lidar_jax.simulation.lidar import SWEEP_S, Mount, sample_mount, scan, sensor_pose
from fcos_lidar_jax.simulation.motion import MOTION, pose_at, travelled, velocity_at
from fcos_lidar_jax.simulation.nuscenes_tables import attribute_of, visibility_of
from fcos_lidar_jax.simulation.object_models import LOOKS
from fcos_lidar_jax.simulation.shapes import object_solids, sample_size
from fcos_lidar_jax.simulation.solids import BOX, corners, make_solids
from fcos_lidar_jax.simulation.traffic import CAR_MIDDLE_M, CAR_SIZE_M, Traffic
from fcos_lidar_jax.simulation.world import World, sample_labels, sample_world

FLAT = Ground(np.zeros((1, 3)), 300, 900, 7, 0.0, 3, (0.3, 0.3, 0.3))
FINE = Sensor("fine", even_inclinations(-6, 2, 8), 2048, limit_xy_m=60)


def motion(**fields) -> np.ndarray:
    moves = np.zeros(1, MOTION)
    for name, value in fields.items():
        moves[name] = value
    return moves


MOTIONS = {
    "still": motion(x=3, y=-1, yaw=2),
    "straight": motion(speed=7, yaw=-0.4),
    "braking to rest": motion(speed=6, acceleration=-2, yaw=1),
    "starting": motion(acceleration=0.9),
    "left": motion(x=-5, speed=5, straight=8, curvature=1 / 12, turn=np.pi / 2),
    "right, slowing": motion(speed=6, acceleration=-0.5, straight=5, curvature=-1 / 7, turn=-np.pi / 2, yaw=0.3),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_positions_are_the_integral_of_speed_along_the_heading(name):
    m = MOTIONS[name][0]
    end = m["straight"] + (m["turn"] / m["curvature"] if m["curvature"] else 0)

    def rate(t, state):
        _, _, yaw, way = state
        speed = max(m["speed"] + m["acceleration"] * t, 0.0)
        return [
            speed * np.cos(yaw),
            speed * np.sin(yaw),
            speed * m["curvature"] * (m["straight"] < way < end),
            speed,
        ]

    times = np.linspace(0, 8, 33)
    path = solve_ivp(rate, (0, 8), [m["x"], m["y"], m["yaw"], 0], t_eval=times, max_step=0.002, rtol=1e-8)
    found = pose_at(MOTIONS[name], times)
    np.testing.assert_allclose(found[:, :2], path.y[:2].T, atol=0.03)
    np.testing.assert_allclose(found[:, 2], path.y[2], atol=4e-3)
    step = 1e-5
    slope = (pose_at(MOTIONS[name], times + step) - pose_at(MOTIONS[name], times))[:, :2] / step
    np.testing.assert_allclose(velocity_at(MOTIONS[name], times), slope, atol=1e-3)
    assert (travelled(MOTIONS[name], times)[1] >= 0).all()


@pytest.fixture(scope="module")
def worlds() -> list[World]:
    return [
        sample_world(
            np.random.default_rng(seed),
            reach_m=60,
            beyond_m=80,
            duration_s=6.0,
            labels=sample_labels(np.random.default_rng(seed), 70),
        )
        for seed in range(5)
    ]


def footprint(pose, size):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return Polygon(
        [(pose[0] + (c * i * size[0] - s * j * size[1]) / 2, pose[1] + (s * i * size[0] + c * j * size[1]) / 2)
         for i, j in signs]
    )  # fmt: skip


def assert_nothing_touches(world, time_s):
    poses = world.object_poses(time_s)[:, [0, 1, 3]]
    car = pose_at(world.ego, time_s)[0]
    car[:2] += CAR_MIDDLE_M * np.array([np.cos(car[2]), np.sin(car[2])])
    shapes = [footprint(p, s) for p, s in zip(poses, world.traffic.sizes, strict=True)]
    shapes.append(footprint(car, CAR_SIZE_M))
    for i, shape in enumerate(shapes):
        assert all(shape.disjoint(other) for other in shapes[:i]), time_s


def test_objects_never_touch_each_other_or_the_car(worlds):
    for world in worlds:
        for time_s in (0.0, 2.5, 6.0):
            assert_nothing_touches(world, time_s)


@pytest.fixture(scope="module")
def hurried() -> list[World]:
    """Streets of ten sweeps, the last half of them with a crossing within reach."""
    return [
        sample_world(
            np.random.default_rng(seed),
            reach_m=12 if seed < 10 else 50,
            beyond_m=20,
            duration_s=0.45,
            labels=np.tile(np.arange(10), 2 if seed < 10 else 6),
            fused=True,
            fast_traffic=True,
        )
        for seed in range(14)
    ]


def test_hurried_objects_never_touch_between_two_sweeps_either(hurried):
    for world in hurried:
        for time_s in np.linspace(0, 0.45, 24):
            assert_nothing_touches(world, time_s)


def test_hurried_cars_drive_straight_every_lane_flows_and_objects_are_near_at_the_end(hurried):
    speeds = np.array([np.linalg.norm(pose_at(w.ego, 0.45) - pose_at(w.ego, 0.0)) / 0.45 for w in hurried])
    assert ((speeds >= 10) & (speeds <= 20)).all()
    assert np.ptp(speeds) > 4
    crossing = 0
    for world in hurried:
        moves = world.traffic.motions
        assert pose_at(world.ego, 9.0)[0, 1] == world.ego["y"][0]
        fast = moves[np.isin(world.traffic.labels, [0, 1, 2, 3, 4, 6]) & (moves["speed"] > 0)]
        assert ((fast["speed"] >= 8) & (fast["speed"] <= 20)).all()
        assert (fast["acceleration"] == 0).all()
        crossing += (np.abs(np.sin(fast["yaw"])) > 0.9).sum()
        singles = world.object_poses(0.45)[~np.isin(world.traffic.labels, [0, 3, 8, 9])]  # others stand in rows
        away = np.hypot(*(singles[:, :2] - pose_at(world.ego, 0.45)[0, :2]).T)
        assert (away < (12 if len(world.traffic.labels) <= 20 else 50) + 30).all()
    assert crossing > 5


def test_streets_hold_all_classes_moving_and_parked_cars_and_every_manoeuvre(worlds):
    for world in worlds:
        assert len(np.unique(world.traffic.labels)) >= 9
    cars = np.concatenate([w.traffic.motions["speed"][w.traffic.labels == 0] for w in worlds])
    assert min((cars > 2).mean(), (cars == 0).mean()) > 0.1
    egos = np.array(
        [
            sample_world(
                np.random.default_rng(seed), reach_m=9, beyond_m=9, duration_s=2.0, labels=np.zeros(0, int)
            ).ego[0]
            for seed in range(40)
        ]
    )
    kinds = [egos["turn"] > 0, egos["turn"] < 0, (egos["speed"] == 0) & (egos["acceleration"] == 0)]
    kinds += [egos["acceleration"] > 0, egos["acceleration"] < 0]
    assert all(kind.any() for kind in kinds)
    slopes = np.concatenate([w.ground.planes[:, :2].ravel() for w in worlds])
    assert np.abs(slopes).max() > 0.005


def test_solids_stay_in_the_boxes_that_are_annotated():
    """But for a fence on a barrier, which real annotations leave out too."""
    rng = np.random.default_rng(0)
    for name, looks in LOOKS.items():
        for look in looks:
            for _ in range(20):
                size = sample_size(rng, look)
                solids = object_solids(look, size, 0.2)
                boxed = solids[solids["density"] != 40.0]
                ends = corners(boxed)
                room = np.array([0.62, 0.62, 1]) * size + 1e-9  # those are cuboids around what leans
                assert (np.abs(ends[..., :2]).max(axis=(0, 1)) <= room[:2]).all(), (name, size)
                assert ends[..., 2].min() >= -1e-9
                assert 0.85 * size[2] < ends[..., 2].max() <= room[2], (name, size)


def test_a_truck_is_not_a_big_car():
    """Seen from the side, shapes of one size differ by class in how much of the box they fill."""
    size = np.array([7.0, 2.4, 2.6])
    fan = np.stack(np.meshgrid(np.linspace(-3.4, 3.4, 60), np.linspace(0.1, 2.5, 40), indexing="ij"), -1).reshape(
        -1, 2
    )
    fills = {}
    for name in ("car", "truck", "bus", "construction_vehicle"):
        per_look = []
        for look in LOOKS[name]:
            solids = object_solids(look, size, 0.2)
            solids = solids[(solids["kind"] == BOX) & np.isinf(solids["density"])]
            inside = (
                (np.abs(fan[:, None] - solids["center"][:, [0, 2]]) <= solids["half"][:, [0, 2]]).all(-1).any(-1)
            )
            per_look.append(inside.reshape(60, 40))
        fills[name] = per_look
    for car in fills["car"]:
        for name in ("truck", "bus", "construction_vehicle"):
            for other in fills[name]:
                union, both = (car | other).sum(), (car & other).sum()
                assert both / union < 0.8, name


@pytest.mark.parametrize(
    ("name", "speed", "expected"),
    [
        ("car", 0.3, "vehicle.moving"),
        ("bus", 0.0, "vehicle.stopped"),
        ("truck", 0.1, "vehicle.stopped"),
        ("pedestrian", 1.0, "pedestrian.moving"),
        ("pedestrian", 0.0, "pedestrian.standing"),
        ("bicycle", 3.0, "cycle.with_rider"),
        ("barrier", 0.0, None),
        ("traffic_cone", 0.0, None),
    ],
)
def test_attributes_follow_class_and_speed(name, speed, expected):
    assert attribute_of(name, speed, rider=speed > 2, parked=False) == expected
    if name in ("car", "truck"):
        assert attribute_of(name, 0.0, rider=False, parked=True) == "vehicle.parked"


def made_by_hand(ego, objects, scenery=None) -> World:
    """A flat world of cuboids: ``objects`` are (x, y, yaw, speed, size)."""
    parts, motions = [], np.zeros(len(objects), MOTION)
    for k, (x, y, yaw, speed, size) in enumerate(objects):
        for name, value in (("x", x), ("y", y), ("yaw", yaw), ("speed", speed)):
            motions[name][k] = value
        half = np.array(size) / 2
        parts.append(make_solids(BOX, [0, 0, half[2]], half, owner=k, albedo=0.8))
    sizes = np.array([o[4] for o in objects], float).reshape(-1, 3)
    traffic = Traffic(
        np.zeros(len(objects), np.int32),
        (LOOKS["car"][0],) * len(objects),
        sizes,
        motions,
        np.zeros(len(objects), bool),
    )
    nothing = make_solids(BOX, np.zeros((0, 3)), 1.0)
    solids = np.concatenate([nothing, *parts])
    return World(FLAT, nothing if scenery is None else scenery, traffic, solids, ego)


def level_mount() -> Mount:
    return sample_mount(np.random.default_rng(0), FINE, level=True)


def in_street(world, mount, sweep, time_s) -> np.ndarray:
    """The points of a sweep that came back, in the street's frame."""
    pose = sensor_pose(world, mount, time_s)
    return sweep.points[sweep.returned, :3].astype(float) @ pose[:3, :3].T + pose[:3, 3]


def test_points_of_moving_objects_trail_behind_and_static_ones_line_up():
    wall = make_solids(BOX, [10, 30, 4], [60, 0.5, 6], albedo=0.8)
    ego = motion(speed=6.0, straight=4, curvature=1 / 30, turn=np.pi / 2)
    world = made_by_hand(ego, [(8, 12, 0.0, 8.0, (4, 2, 3))], wall)
    mount = level_mount()
    fronts, walls = [], []
    for lag in range(0, 10, 3):
        time_s = 1.0 - lag * SWEEP_S
        points = in_street(world, mount, scan(world, FINE, mount, time_s, np.random.default_rng(lag)), time_s)
        on_object = points[(points[:, 2] > 0.5) & (points[:, 1] < 14) & (points[:, 1] > 10)]
        fronts.append([on_object[:, 0].min(), on_object[:, 0].max()])
        walls.append(points[(points[:, 1] > 28) & (points[:, 2] > 0.5), 1])
    lags = np.arange(0, 10, 3) * SWEEP_S
    # Within a ray's spacing and the noise: the object is 8 m/s further back with every second.
    np.testing.assert_allclose(np.array(fronts).mean(axis=1), 8 + 8 * (1.0 - lags), atol=0.12)
    assert all(abs(np.mean(w) - 29.5) < 0.005 and np.abs(w - 29.5).max() < 0.08 for w in walls)
    assert min(map(len, walls)) > 500


def test_fused_sweeps_meet_at_what_stands_and_begin_with_the_current_one():
    wall = make_solids(BOX, [10, 30, 4], [60, 0.5, 6], albedo=0.8)
    ego = motion(speed=14.0, straight=4, curvature=1 / 30, turn=np.pi / 2)
    world, mount = made_by_hand(ego, [(8, 12, 0.0, 8.0, (4, 2, 3))], wall), level_mount()
    points, _ = scan_sweeps(world, FINE, mount, 1.0, np.random.default_rng(7), num_sweeps=10)
    lags = (np.arange(10) * SWEEP_S).astype(np.float32)
    np.testing.assert_array_equal(points[np.r_[True, np.diff(points[:, 4]) != 0], 4], lags)
    current = scan(world, FINE, mount, 1.0, np.random.default_rng(7))
    alone = current.points[current.returned][:, :4]
    np.testing.assert_array_equal(points[points[:, 4] == 0, :4], alone)
    now = sensor_pose(world, mount, 1.0)
    off = []
    for age, lag in enumerate(lags):
        local = points[points[:, 4] == lag, :3].astype(float)
        there = local @ now[:3, :3].T + now[:3, 3]
        on_wall = there[(there[:, 1] > 28) & (there[:, 2] > 0.5), 1]
        assert len(on_wall) > 500
        assert abs(on_wall.mean() - 29.5) < 0.005
        assert np.abs(on_wall - 29.5).max() < 0.08
        moved = there[(there[:, 2] > 0.5) & (there[:, 1] < 14) & (there[:, 1] > 10), 0]
        assert (moved.min() + moved.max()) / 2 == pytest.approx(8 + 8 * (1 - lag), abs=0.12)
        then = sensor_pose(world, mount, 1.0 - age * SWEEP_S)
        own = (there - then[:3, 3]) @ then[:3, :3]
        unmoved = own @ now[:3, :3].T + now[:3, 3]  # as a fusion without poses has it
        off.append(np.median(np.abs(unmoved[there[:, 1] > 28] - there[there[:, 1] > 28]).max(axis=1)))
    assert off[0] < 1e-3
    assert off[-1] > 4  # metres: the poses decide


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_a_rolling_shutter_smears_what_moves_and_leaves_the_rest_in_place(speed):
    wall = make_solids(BOX, [10, 30, 4], [60, 0.5, 6], albedo=0.8)
    beside = [(x, -9.0, 0.0, 12.0, (4, 2, 3)) for x in (-12, 0, 12)]
    world = made_by_hand(motion(speed=speed), beside, wall)
    mount, found = level_mount(), []
    for rolling in (False, True):
        sweep = scan(world, FINE, mount, 1.0, np.random.default_rng(5), rolling_shutter=rolling)
        points = in_street(world, mount, sweep, 1.0)
        on_wall = points[(points[:, 1] > 28) & (points[:, 2] > 0.5), 1]
        assert np.abs(np.mean(on_wall) - 29.5) < 0.005
        assert np.abs(on_wall - 29.5).max() < 0.08
        objects = points[(points[:, 1] < -7) & (points[:, 2] > 0.5)]
        found.append([objects[np.abs(objects[:, 0] - x - 12) < 4, 0].mean() for x in (-12, 0, 12)])
    still, rolled = np.array(found)
    shift = still - rolled  # metres that the objects were behind when the beam passed
    assert ((shift > -0.05) & (shift < 12 * SWEEP_S + 0.05)).all(), shift
    assert np.ptp(shift) > 0.05  # the beam passes one after the other
    if speed == 0:
        assert shift.max() > 0.1


def test_the_share_that_is_seen_is_that_of_the_free_rays():
    objects = [(20, 0, 0, 0, (0.2, 8, 3)), (10, 1, 0, 0, (0.2, 2, 3)), (-15, 0, 0, 0, (2, 2, 2))]
    world, mount = made_by_hand(motion(), objects), level_mount()
    share = scan(world, FINE, mount, 0.0, np.random.default_rng(0)).seen_share
    eye = sensor_pose(world, mount, 0.0)[:3, 3]
    wide = 2 * np.arctan2(4, 19.9 - eye[0])
    hidden = np.arctan2(2, 9.9 - eye[0])
    # Every ray that the far one's three metres can take meets the near one where that stands.
    assert share[0] == pytest.approx(1 - hidden / wide, abs=0.04)
    assert share[1] == share[2] == 1
    assert [visibility_of(float(s)) for s in share] == ["2", "4", "4"]


def test_far_dark_and_grazing_returns_are_lost():
    mount = level_mount()
    kept = {}
    for name, x, albedo in (("near", 10, 0.5), ("far", 55, 0.5), ("far and dark", 55, 0.01)):
        wall = make_solids(BOX, [x, 0, 0], [0.5, 40, 8], albedo=albedo)
        sweep = scan(made_by_hand(motion(), [], wall), FINE, mount, 0.0, np.random.default_rng(0))
        kept[name] = sweep.returned.reshape(-1, FINE.num_rows)[:, 5:].sum()  # the rays that rise
    assert kept["near"] > kept["far"] * 1.5 > 1.5 * kept["far and dark"]
    road = scan(made_by_hand(motion(), []), FINE, mount, 0.0, np.random.default_rng(0))
    lasers = road.returned.reshape(-1, FINE.num_rows)
    assert lasers[:, 0].mean() > 0.9 > lasers[:, 4].mean()  # the ground at 18 m and beyond 70 m


def test_intensity_follows_material_and_angle():
    mount, means = level_mount(), {}
    for name, albedo, yaw in (("bright", 0.5, 0.0), ("dark", 0.1, 0.0), ("oblique", 0.5, 1.2)):
        plate = make_solids(BOX, [12, 0, 2], [0.05, 1, 3], albedo=albedo, yaw=yaw)
        sweep = scan(made_by_hand(motion(), [], plate), FINE, mount, 0.0, np.random.default_rng(0))
        local = sweep.points[sweep.returned]
        means[name] = local[(local[:, 2] > -1) & (np.linalg.norm(local[:, :3], axis=1) > 5), 3].mean()
    assert means["bright"] / means["dark"] == pytest.approx(5, rel=0.15)
    assert means["oblique"] < 0.85 * means["bright"]


def test_rays_without_return_lie_about_the_sensor_and_points_tell_their_laser():
    world = made_by_hand(motion(), [])
    sweep = scan(
        world, TINY, sample_mount(np.random.default_rng(0), TINY, level=True), 0.0, np.random.default_rng(0)
    )
    lost = sweep.points[~sweep.returned]
    assert len(lost) > 100
    assert np.abs(lost[:, :3]).max() < 0.15
    assert sweep.points.shape == (TINY.num_rows * TINY.num_columns, 5)
    np.testing.assert_array_equal(sweep.points[:, 4], np.tile(np.arange(TINY.num_rows), TINY.num_columns))
    back = sweep.points[sweep.returned]
    slope = np.arctan2(back[:, 2], np.hypot(back[:, 0], back[:, 1]))
    expected = np.array(TINY.inclinations_rad)[::-1][back[:, 4].astype(int)]
    np.testing.assert_allclose(slope, expected, atol=1e-4)
