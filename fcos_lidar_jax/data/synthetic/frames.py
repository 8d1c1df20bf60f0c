"""Simulated frames: one sweep with its boxes."""

import numpy as np

from fcos_lidar_jax.data.frame import Frame, count_inside
from fcos_lidar_jax.data.synthetic.raycast import scan
from fcos_lidar_jax.data.synthetic.world import make_scene
from fcos_lidar_jax.sensors import Sensor


def make_frame(seed: int, sensor: Sensor, *, num_objects: int = 12) -> Frame:
    """A simulated frame; the same seed gives the same bytes, in whatever order frames are made.

    Only objects that a point shows are annotated.

    Args:
        seed: any non-negative integer.
        sensor: who looks.
        num_objects: to place.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> a, b = make_frame(3, TINY), make_frame(3, TINY)
    >>> bool((a.points == b.points).all()), bool((a.num_points >= 1).all())
    (True, True)
    """
    scene = make_scene(seed, reach_m=0.8 * sensor.limit_xy_m, num_objects=num_objects)
    points = scan(scene, sensor, np.random.default_rng([seed, 0x5CA7]))
    boxes = scene.boxes.copy()
    boxes[:, :3] += np.array(sensor.origin_m)
    boxes = boxes.astype(np.float32)
    counts = count_inside(points, boxes)
    shown = counts > 0
    return Frame(points, boxes[shown], scene.labels[shown], counts[shown])
