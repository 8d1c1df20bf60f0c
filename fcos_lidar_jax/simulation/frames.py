"""Simulated frames: one sweep or several fused sweeps, with the boxes at the time of the current sweep."""

import dataclasses

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import WHOLE_SWEEP, CloudReading
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation.lidar import SWEEP_S, sample_mount, scan
from fcos_lidar_jax.simulation.motion import velocity_at
from fcos_lidar_jax.simulation.streets import PLAIN, Streets
from fcos_lidar_jax.simulation.world import World, class_shares, sample_world


def make_frame(
    seed: int,
    sensor: Sensor,
    *,
    num_objects: int = 12,
    reach_m: float | None = None,
    min_points: int = 1,
    reading: CloudReading = WHOLE_SWEEP,
    fast_traffic: bool = False,
    streets: Streets = PLAIN,
) -> Frame:
    """Simulate a frame of a street. The bytes depend only on the arguments, not on the order of calls.

    In plain streets all ten classes are equally frequent. Rays without a return are omitted.

    Args:
        seed: any non-negative integer.
        num_objects: number of objects, or their mean with ``streets.setting``; objects without room are omitted.
        reach_m: maximum distance along the street of each object, or of the first object of its row; by default
            80 % of the sensor's range limit.
        min_points: objects with fewer points in the current sweep are not annotated.
        reading: the sweeps to fuse, see :func:`scan_sweeps`; the world moves between sweeps.
    """
    rng = np.random.default_rng([seed, 0xF0C5])
    mix = rng.spawn(1)[0]
    if streets.setting:
        num_objects = round(num_objects * np.clip(mix.lognormal(-0.15, 0.6), 0.05, 2.5))
    if streets.city_classes:
        shares = class_shares(streets.city_classes) * np.exp(streets.class_mix * mix.standard_normal(10))
        labels = rng.choice(len(NUSCENES_CLASSES), num_objects, p=shares / shares.sum())
    else:
        labels = rng.permutation(np.resize(rng.permutation(len(NUSCENES_CLASSES)), num_objects))
    reach = 0.8 * sensor.limit_xy_m if reach_m is None else reach_m
    now_s = (reading.num_sweeps - 1 + streets.rolling_shutter) * SWEEP_S
    options = {"level": not streets.slopes, "fused": True, "fast_traffic": fast_traffic, "streets": streets}
    world = sample_world(rng, reach_m=reach, beyond_m=2 * reach, duration_s=now_s, labels=labels, **options)
    mount = sample_mount(rng, sensor, level=not streets.slopes, streets=streets)
    points, num_close = scan_sweeps(world, sensor, mount, now_s, rng, reading)
    boxes = boxes_in_sensor_frame(world, world.ego_pose(now_s) @ mount, now_s).astype(np.float32)
    counts = count_inside(points[points[:, 4] == 0], boxes)
    visible = counts >= max(min_points, 1)
    return Frame(points, boxes[visible], world.traffic.labels[visible], counts[visible], num_close)


def scan_sweeps(
    world: World,
    sensor: Sensor,
    mount: np.ndarray,
    time_s: float,
    rng: np.random.Generator,
    reading: CloudReading,
) -> tuple[np.ndarray, int]:
    """Fuse the sweeps up to a moment in the sensor's frame at that moment, current sweep first, then by age.

    Sweeps are ``SWEEP_S`` apart. Close points are removed from all sweeps or from no sweep. In plain streets
    they lie on the roof of the ego vehicle.

    Returns points f32[n, c] as in :class:`fcos_lidar_jax.data.frame.Frame`, with lag exactly 0 for the current
    sweep, and the number of removed points.
    """

    def take_sweep(age: int) -> Sweep:
        then_s = time_s - age * SWEEP_S
        sweep = scan(world, sensor, mount, then_s, rng, rolling_shutter=world.streets.rolling_shutter)
        points = sweep.points[sweep.returned]
        columns = [points[:, :4], np.zeros((len(points), 1), np.float32)]
        if sensor.row_source == "laser":
            columns.append(sensor.num_rows - 1 - points[:, 4:])
        pose = world.ego_pose(then_s) @ mount
        return Sweep(np.concatenate(columns, axis=1), pose, -age * round(SWEEP_S * 1e6))

    removed = "none" if reading.remove_close == "none" else "all"
    reading = dataclasses.replace(reading, remove_close=removed)
    return fuse_sweeps(map(take_sweep, range(reading.num_sweeps)), sensor, reading)


def boxes_in_sensor_frame(world: World, pose: np.ndarray, time_s: float) -> np.ndarray:
    """Boxes ``x, y, z, l, w, h, yaw, vx, vy`` of all objects, f64[m, 9], in the point frame at ``pose``."""
    placed, sizes = world.object_poses(time_s), world.traffic.sizes
    center = placed[:, :3] + sizes * (0, 0, 0.5)
    heading = np.stack([np.cos(placed[:, 3]), np.sin(placed[:, 3]), 0 * placed[:, 3]], axis=1) @ pose[:3, :3]
    velocity = np.pad(velocity_at(world.traffic.motions, time_s), ((0, 0), (0, 1))) @ pose[:3, :3]
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    xyz = (center - pose[:3, 3]) @ pose[:3, :3]
    return np.concatenate([xyz, sizes, yaw[:, None], velocity[:, :2]], axis=1)
