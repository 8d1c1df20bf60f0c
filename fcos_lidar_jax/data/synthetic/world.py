"""A seeded street scene of simple solids: ground, walls, poles, and objects of the ten classes.

Everything is relative to the sensor: x right, y forward, z up, metres; the ground is flat.
"""

import dataclasses

import numpy as np
from numpy.random import Generator

from fcos_lidar_jax.types import CLASSES

GROUND_Z = -1.84
"""The sensor stands this far above the ground."""
_MARGIN_M = 0.04
"""An annotated box stands off from the solids by this on every side, as hand-drawn boxes do."""
_NEAREST_M = 2.5
"""Nothing stands closer to the sensor."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """Solids and the boxes around the objects among them."""

    cuboids: np.ndarray
    """f64[c, 7]: ``x, y, z, l, w, h, yaw`` of upright cuboids."""
    cuboid_albedo: np.ndarray
    """f64[c]: reflectivity, 0-1."""
    cylinders: np.ndarray
    """f64[y, 5]: ``x, y, radius, low z, high z`` of upright cylinders."""
    cylinder_albedo: np.ndarray
    """f64[y]: reflectivity, 0-1."""
    boxes: np.ndarray
    """f64[m, 9]: ``x, y, z, l, w, h, yaw, vx, vy`` of the objects."""
    labels: np.ndarray
    """i32[m]: index into ``types.CLASSES``."""


@dataclasses.dataclass(frozen=True)
class _Shape:
    """A class: its box, how fast it moves, and its solids as parts of the box.

    Cuboids are ``x, y, l, w`` as fractions of length and width and ``low, high`` as fractions of the height;
    cylinders ``x, y, radius`` (of the smaller side), ``low, high``.
    """

    size: tuple[float, float, float]
    max_speed: float
    cuboids: tuple[tuple[float, ...], ...] = ()
    cylinders: tuple[tuple[float, ...], ...] = ()


_WHEELS = tuple((x, y, 0.12, 0.2, 0.0, 0.25) for x in (-0.3, 0.3) for y in (-0.38, 0.38))

SHAPES: dict[str, _Shape] = {
    "car": _Shape((4.6, 1.95, 1.73), 12, ((0, 0, 1, 1, 0.15, 0.6), (-0.06, 0, 0.52, 0.88, 0.6, 1), *_WHEELS)),
    "truck": _Shape(
        (6.9, 2.5, 2.85), 10, ((0.39, 0, 0.22, 0.92, 0.12, 0.78), (-0.14, 0, 0.72, 1, 0.25, 1), *_WHEELS)
    ),
    "bus": _Shape((11.0, 2.9, 3.5), 10, ((0, 0, 1, 1, 0.1, 1), *_WHEELS)),
    "trailer": _Shape(
        (12.0, 2.9, 3.9),
        0,
        ((0, 0, 1, 1, 0.32, 1), (-0.33, 0, 0.25, 0.9, 0, 0.32), (0.4, 0, 0.04, 0.5, 0, 0.32)),
    ),
    "construction_vehicle": _Shape(
        (6.4, 2.85, 3.2),
        2,
        (
            (-0.2, 0, 0.6, 1, 0, 0.4),
            (-0.25, 0, 0.3, 0.6, 0.4, 1),
            (0.25, 0, 0.5, 0.2, 0.5, 0.68),
            (0.45, 0, 0.1, 0.7, 0.05, 0.5),
        ),
    ),
    "pedestrian": _Shape(
        (0.73, 0.67, 1.77),
        1.8,
        (),
        ((0, 0.25, 0.2, 0, 0.5), (0, -0.25, 0.2, 0, 0.5), (0, 0, 0.5, 0.45, 0.85), (0, 0, 0.2, 0.85, 1)),
    ),
    "motorcycle": _Shape(
        (2.1, 0.77, 1.47),
        10,
        ((0, 0, 1, 0.3, 0.05, 0.55), (-0.1, 0, 0.2, 0.6, 0.5, 1), (0.25, 0, 0.06, 1, 0.6, 0.75)),
    ),
    "bicycle": _Shape(
        (1.7, 0.6, 1.28),
        4,
        ((0, 0, 1, 0.12, 0.02, 0.6), (0.25, 0, 0.06, 1, 0.7, 0.85), (-0.2, 0, 0.14, 0.4, 0.6, 1)),
    ),
    "traffic_cone": _Shape(
        (0.41, 0.41, 1.07), 0, (), ((0, 0, 0.5, 0, 0.08), (0, 0, 0.36, 0.08, 0.5), (0, 0, 0.2, 0.5, 1))
    ),
    "barrier": _Shape((0.5, 2.5, 1.0), 0, ((0, 0, 1, 1, 0, 0.3), (0, 0, 0.45, 1, 0.3, 1))),
}
"""Sizes near the class means of nuScenes (for barriers the width is the long side, as there)."""


def _rectangles_overlap(a: np.ndarray, others: np.ndarray, gap_m: float) -> bool:
    """Whether a rectangle ``x, y, l, w, yaw`` comes within ``gap_m`` of any other, by separating axes."""

    def corners(r: np.ndarray) -> np.ndarray:
        c, s = np.cos(r[..., 4]), np.sin(r[..., 4])
        along = np.stack([c, s], -1) * (r[..., 2, None] + gap_m) / 2
        across = np.stack([-s, c], -1) * (r[..., 3, None] + gap_m) / 2
        signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        return np.stack([r[..., :2] + i * along + j * across for i, j in signs], -2)

    if len(others) == 0:
        return False
    mine, theirs = corners(a)[None], corners(others)
    apart = np.zeros(len(others), bool)
    for yaw in (np.broadcast_to(a[4], len(others)), others[:, 4]):
        for axis in (np.stack([np.cos(yaw), np.sin(yaw)], -1), np.stack([-np.sin(yaw), np.cos(yaw)], -1)):
            p, q = (np.einsum("mkd,md->mk", c, axis) for c in (np.repeat(mine, len(others), 0), theirs))
            apart |= (p.min(1) > q.max(1)) | (q.min(1) > p.max(1))
    return bool((~apart).any())


def _too_close(rectangle: np.ndarray) -> bool:
    """Whether a rectangle comes within the free zone around the sensor."""
    x, y, l, w, yaw = rectangle
    dx = abs(np.cos(yaw) * x + np.sin(yaw) * y) - l / 2
    dy = abs(np.cos(yaw) * y - np.sin(yaw) * x) - w / 2
    return bool(np.hypot(max(dx, 0), max(dy, 0)) < _NEAREST_M)


def _place(
    rng: Generator,
    size: tuple[float, float],
    near_m: float,
    far_m: float,
    taken: list[np.ndarray],
    gap_m: float,
) -> np.ndarray | None:
    """A free rectangle ``x, y, l, w, yaw``, its distance uniform; None where no room was found."""
    for _ in range(30):
        distance, bearing = rng.uniform(near_m, far_m), rng.uniform(-np.pi, np.pi)
        yaw = rng.uniform(-np.pi, np.pi)
        spot = np.array([distance * np.cos(bearing), distance * np.sin(bearing), *size, yaw])
        others = np.array(taken).reshape(-1, 5)
        if not _too_close(spot) and not _rectangles_overlap(spot, others, gap_m):
            return spot
    return None


def _solids(shape: _Shape, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An object's cuboids and cylinders in the world."""
    x, y, z, l, w, h, yaw = box[:7]
    l, w, h = l - 2 * _MARGIN_M, w - 2 * _MARGIN_M, h - _MARGIN_M
    bottom = z - box[5] / 2
    cos, sin = np.cos(yaw), np.sin(yaw)

    def at(fx: float, fy: float) -> tuple[float, float]:
        return x + cos * fx * l - sin * fy * w, y + sin * fx * l + cos * fy * w

    cuboids = [
        (*at(fx, fy), bottom + h * (low + high) / 2, fl * l, fw * w, h * (high - low), yaw)
        for fx, fy, fl, fw, low, high in shape.cuboids
    ]
    cylinders = [
        (*at(fx, fy), radius * min(l, w), bottom + low * h, bottom + high * h)
        for fx, fy, radius, low, high in shape.cylinders
    ]
    return np.array(cuboids).reshape(-1, 7), np.array(cylinders).reshape(-1, 5)


def make_scene(seed: int, *, reach_m: float, num_objects: int = 12) -> Scene:
    """A random scene; the same seed gives the same scene.

    Args:
        seed: any non-negative integer.
        reach_m: objects stand within this distance of the sensor; walls may stand farther.
        num_objects: to place; fewer where there is no room.

    >>> scene = make_scene(0, reach_m=20.0)
    >>> scene.boxes.shape[1], len(scene.boxes) == len(scene.labels)
    (9, True)
    """
    rng = np.random.default_rng([seed, 0xF0C5])
    taken: list[np.ndarray] = []
    cuboids, cylinders, albedo = [], [], ([], [])
    boxes, labels = [], []

    def add(parts: tuple[np.ndarray, np.ndarray], brightness: float) -> None:
        for store, solids, kind in zip((cuboids, cylinders), parts, albedo, strict=True):
            store.append(solids)
            kind.extend([brightness] * len(solids))

    order = rng.permutation(np.resize(rng.permutation(len(CLASSES)), num_objects))
    for label in sorted(order, key=lambda k: -np.prod(SHAPES[CLASSES[k]].size)):  # the large ones need room
        shape = SHAPES[CLASSES[label]]
        l, w, h = np.array(shape.size) * np.clip(rng.normal(1, 0.08, 3), 0.8, 1.2)
        spot = _place(rng, (l, w), _NEAREST_M + l / 4, reach_m, taken, 0.4)
        speed = rng.uniform(0, shape.max_speed) * (rng.random() < 0.6)
        brightness = rng.uniform(0.15, 0.9)
        if spot is None:
            continue
        taken.append(spot)
        yaw = spot[4]
        velocity = speed * np.cos(yaw), speed * np.sin(yaw)
        box = np.array([spot[0], spot[1], GROUND_Z + h / 2, l, w, h, yaw, *velocity])
        boxes.append(box)
        labels.append(label)
        add(_solids(shape, box), brightness)
    for _ in range(rng.integers(2, 5)):  # walls
        size = (rng.uniform(6, 25), rng.uniform(0.3, 6))
        spot = _place(rng, size, 0.5 * reach_m, 1.5 * reach_m, taken, 0.5)
        if spot is not None:
            taken.append(spot)
            height = rng.uniform(2, 12)
            wall = (spot[0], spot[1], GROUND_Z + height / 2, size[0], size[1], height, spot[4])
            add((np.array([wall]), np.zeros((0, 5))), rng.uniform(0.1, 0.5))
    for _ in range(rng.integers(3, 9)):  # poles and trunks
        radius, height = rng.uniform(0.06, 0.3), rng.uniform(2.5, 9)
        spot = _place(rng, (2 * radius, 2 * radius), 0.2 * reach_m, 1.2 * reach_m, taken, 0.3)
        if spot is not None:
            taken.append(spot)
            pole = (spot[0], spot[1], radius, GROUND_Z, GROUND_Z + height)
            add((np.zeros((0, 7)), np.array([pole])), rng.uniform(0.1, 0.6))
    return Scene(
        np.concatenate([np.zeros((0, 7)), *cuboids]),
        np.array(albedo[0]),
        np.concatenate([np.zeros((0, 5)), *cylinders]),
        np.array(albedo[1]),
        np.array(boxes).reshape(-1, 9),
        np.array(labels, np.int32),
    )
