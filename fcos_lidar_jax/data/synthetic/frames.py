"""Simulated frames: one sweep with its boxes."""

import dataclasses

import numpy as np

from fcos_lidar_jax.data.synthetic.raycast import scan
from fcos_lidar_jax.data.synthetic.world import make_scene
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class Frame:
    """Points and boxes of one sweep, unpadded."""

    points: np.ndarray
    """f32[n, c]: x, y, z, intensity, time lag, ..."""
    boxes: np.ndarray
    """f32[m, 9]: ``x, y, z, l, w, h, yaw, vx, vy``."""
    labels: np.ndarray
    """i32[m]: index into ``types.CLASSES``."""
    num_points: np.ndarray
    """i32[m]: points inside each box."""


def count_inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Points inside each upright box, boundary included, i32[m].

    >>> count_inside(np.zeros((2, 3)), np.array([[0, 0, 0, 1, 1, 1, 0.3]])).tolist()
    [2]
    """
    counts = []
    for x, y, z, l, w, h, yaw in np.asarray(boxes, np.float64)[:, :7]:
        dx, dy, dz = (points[:, i].astype(np.float64) - c for i, c in enumerate((x, y, z)))
        along, across = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
        inside = (np.abs(along) <= l / 2) & (np.abs(across) <= w / 2) & (np.abs(dz) <= h / 2)
        counts.append(int(inside.sum()))
    return np.array(counts, np.int32)


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
