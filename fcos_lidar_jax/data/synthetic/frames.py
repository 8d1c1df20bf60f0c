"""Simulated frames: one sweep with its boxes."""

import numpy as np

from fcos_lidar_jax.data.frame import Frame, count_inside
from fcos_lidar_jax.data.synthetic.lidar import draw_mount, scan, sensor_pose
from fcos_lidar_jax.data.synthetic.motion import velocity_at
from fcos_lidar_jax.data.synthetic.world import World, draw_world
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import CLASSES


def make_frame(seed: int, sensor: Sensor, *, num_objects: int = 12, reach_m: float | None = None) -> Frame:
    """A simulated frame of a level street; the same seed gives the same bytes, in whatever order frames are made.

    All ten classes occur equally often. Only objects that a point shows are annotated, and rays without a return
    are left out.

    Args:
        seed: any non-negative integer.
        sensor: who looks.
        num_objects: to place; fewer where there is no room.
        reach_m: greatest distance along the street at which they are placed; default: four fifths of the sensor's.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> a, b = make_frame(3, TINY), make_frame(3, TINY)
    >>> bool((a.points == b.points).all()), bool((a.num_points >= 1).all())
    (True, True)
    """
    rng = np.random.default_rng([seed, 0xF0C5])
    labels = rng.permutation(np.resize(rng.permutation(len(CLASSES)), num_objects))
    reach = 0.8 * sensor.limit_xy_m if reach_m is None else reach_m
    world = draw_world(rng, reach_m=reach, beyond_m=2 * reach, duration_s=0.0, labels=labels, level=True)
    mount = draw_mount(rng, sensor, level=True)
    sweep = scan(world, sensor, mount, 0.0, rng)
    points = sweep.points[sweep.returned]
    columns = [points[:, :4], np.zeros((len(points), 1), np.float32)]
    if sensor.row_source == "laser":
        columns.append(sensor.num_rows - 1 - points[:, 4:])
    points = np.concatenate(columns, axis=1)
    boxes = boxes_in_sensor_frame(world, sensor_pose(world, mount, 0.0), 0.0).astype(np.float32)
    counts = count_inside(points, boxes)
    shown = counts > 0
    return Frame(points, boxes[shown], world.traffic.labels[shown], counts[shown])


def boxes_in_sensor_frame(world: World, pose: np.ndarray, time_s: float) -> np.ndarray:
    """``x, y, z, l, w, h, yaw, vx, vy`` of all objects in the points' frame, f64[m, 9].

    Args:
        world: in the street's frame.
        pose: f64[4, 4], the points' frame in the street's.
        time_s: when.
    """
    placed, sizes = world.object_poses(time_s), world.traffic.sizes
    center = placed[:, :3] + np.stack([0 * sizes[:, 0], 0 * sizes[:, 0], sizes[:, 2] / 2], axis=1)
    heading = np.stack([np.cos(placed[:, 3]), np.sin(placed[:, 3]), 0 * placed[:, 3]], axis=1) @ pose[:3, :3]
    velocity = np.pad(velocity_at(world.traffic.motions, time_s), ((0, 0), (0, 1))) @ pose[:3, :3]
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    xyz = (center - pose[:3, 3]) @ pose[:3, :3]
    return np.concatenate([xyz, sizes, yaw[:, None], velocity[:, :2]], axis=1)
