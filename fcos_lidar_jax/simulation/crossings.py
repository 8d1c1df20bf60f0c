"""Intersections of rays with solids and angles of incidence, with one vectorised test per kind of solid."""

import numpy as np

from fcos_lidar_jax.simulation.solids import BALL, BOX, DRUM, WHEEL, unit_map

_POROUS_COSINE = 0.5  # incidence on leaves and wires, which have no proper surface


def crossings(
    solids: np.ndarray, which: np.ndarray, rays: np.ndarray, d: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Distance along the ray of each pair to the point where the solid stops it, f32[k]; inf if it does not.

    Args:
        solids: [s], centres relative to the origin of the rays.
        which: i32[k], solid of each pair.
        rays: i32[k], ray of each pair.
        d: f32[3, n], unit vectors.
        rng: source of the penetration depths into porous solids.
    """
    maps = unit_map(solids)
    start = -np.einsum("sij,sj->is", maps, solids["center"]).astype(np.float32)
    maps = np.ascontiguousarray(maps.transpose(1, 2, 0), np.float32)
    taper = solids["taper"].astype(np.float32)
    density = solids["density"].astype(np.float32)
    reach = np.full(len(which), np.inf, np.float32)
    # Straight cuboids are the most frequent solids and have their own, faster test.
    straight = (solids["kind"] == BOX) & (solids["taper"] == 1).all(axis=1)
    shape = np.where(straight, -1, solids["kind"])[which]
    for name, crossing in _CROSSINGS.items():
        pairs = np.flatnonzero(shape == name)
        of = which[pairs]
        v = _to_unit(maps, of, d.take(rays[pairs], axis=1))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            enter, leave = crossing(start.take(of, axis=1), v, taper[of])
            crossed = np.flatnonzero((enter < leave) & (enter > 0))
        enter, leave, thick = enter[crossed], leave[crossed], density[of[crossed]]
        porous = np.flatnonzero(np.isfinite(thick))
        depth = rng.standard_exponential(len(porous), np.float32) / thick[porous]
        enter[porous] += depth
        reach[pairs[crossed]] = np.where(enter <= leave, enter, np.float32(np.inf))
    return reach


def incidence(solids: np.ndarray, which: np.ndarray, points: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Cosine of the angle of incidence of rays on solids, f32[k].

    Args:
        solids: [s], centres relative to the origin of the rays.
        which: i32[k], solid of each ray.
        points: f32[3, k], on the solids.
        d: f32[3, k], unit vectors.
    """
    maps = np.ascontiguousarray(unit_map(solids).transpose(1, 2, 0), np.float32)
    center = np.ascontiguousarray(solids["center"].T, np.float32)
    taper = np.ascontiguousarray(solids["taper"].T, np.float32)
    u = _to_unit(maps, which, points - center.take(which, axis=1))
    normal = np.array(u)  # the normal of a ball
    slope = (taper.take(which, axis=1) - 1) / 2
    bound = np.maximum((1 + slope) + slope * u[2], np.float32(1e-9))
    kind = solids["kind"][which]
    share = np.abs(normal)
    share[:2] /= bound
    face = np.where(kind == BOX, np.argmax(share, axis=0), -1)  # the face of the box that contains the point
    for axis in range(3):
        on = np.flatnonzero(face == axis)
        sign = np.sign(normal[axis, on])
        normal[:, on] = 0
        normal[axis, on] = sign
        if axis < 2:
            normal[2, on] = -slope[axis, on]
    drum = np.flatnonzero(kind == DRUM)
    normal[2, drum] = -slope[0, drum] * bound[0, drum]
    cap = drum[np.abs(u[2][drum]) > np.hypot(u[0][drum], u[1][drum]) / bound[0, drum]]
    normal[:, cap] = np.array([[0], [0], [1]])
    wheel = np.flatnonzero(kind == WHEEL)
    normal[1, wheel] = 0
    side = wheel[np.abs(u[1][wheel]) > np.hypot(u[0][wheel], u[2][wheel])]
    normal[:, side] = np.array([[0], [1], [0]])
    along = _to_unit(maps, which, d)
    m = {(i, j): maps[i, j].take(which) for i, j in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 2))}
    x = m[0, 0] * normal[0] + m[1, 0] * normal[1]
    y = m[0, 1] * normal[0] + m[1, 1] * normal[1]
    z = m[0, 2] * normal[0] + m[2, 2] * normal[2]
    dot = along[0] * normal[0] + along[1] * normal[1] + along[2] * normal[2]
    cosine = np.abs(dot) / np.maximum(np.sqrt(x * x + y * y + z * z), np.float32(1e-9))
    porous = np.isfinite(solids["density"])[which]
    return np.where(porous, np.float32(_POROUS_COSINE), np.minimum(cosine, np.float32(1)))


def _to_unit(maps: np.ndarray, which: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vectors in the axes of the unit shapes. The omitted entries of the maps are 0."""
    return (
        maps[0, 0].take(which) * d[0] + maps[0, 1].take(which) * d[1] + maps[0, 2].take(which) * d[2],
        maps[1, 0].take(which) * d[0] + maps[1, 1].take(which) * d[1],
        maps[2, 2].take(which) * d[2],
    )


def _slab(o: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameters t where rays enter and leave ``|o + t v| <= 1``."""
    inverse = 1 / np.where(v == 0, np.float32(1e-20), v)
    first, second = (-1 - o) * inverse, (1 - o) * inverse
    return np.minimum(first, second), np.maximum(first, second)


def _cross_cuboid(o: np.ndarray, v: tuple[np.ndarray, ...], taper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    spans = [_slab(o[axis], v[axis]) for axis in range(3)]
    enter = np.maximum(np.maximum(spans[0][0], spans[1][0]), spans[2][0])
    return enter, np.minimum(np.minimum(spans[0][1], spans[1][1]), spans[2][1])


def _cross_box(o: np.ndarray, v: tuple[np.ndarray, ...], taper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    enter, leave = _slab(o[2], v[2])
    for axis in (0, 1):
        ratio = taper[:, axis]
        # |u| <= middle + slope * height is the intersection of two half-spaces. A ray enters or leaves each.
        middle, slope = (1 + ratio) / 2, (ratio - 1) / 2
        bound, gain = middle + slope * o[2], slope * v[2]
        for sign in (np.float32(1), np.float32(-1)):
            room, speed = bound - sign * o[axis], sign * v[axis] - gain
            at = room / np.where(speed == 0, np.float32(1e-20), speed)
            leave = np.where(speed > 0, np.minimum(leave, at), leave)
            enter = np.where(speed < 0, np.maximum(enter, at), enter)
            leave = np.where((speed == 0) & (room < 0), np.float32(-np.inf), leave)
    return enter, leave


def _cross_ball(o: np.ndarray, v: tuple[np.ndarray, ...], _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Expand about the point of the ray nearest to the centre, because the squares would cancel far from it.
    a = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    nearest = -(o[0] * v[0] + o[1] * v[1] + o[2] * v[2]) / a
    p = [o[i] + nearest * v[i] for i in range(3)]
    span = np.sqrt((1 - (p[0] * p[0] + p[1] * p[1] + p[2] * p[2])) / a)
    return nearest - span, nearest + span


def _cross_wheel(o: np.ndarray, v: tuple[np.ndarray, ...], _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a = np.maximum(v[0] * v[0] + v[2] * v[2], np.float32(1e-20))
    nearest = -(o[0] * v[0] + o[2] * v[2]) / a
    p, q = o[0] + nearest * v[0], o[2] + nearest * v[2]
    span = np.sqrt((1 - (p * p + q * q)) / a)
    near, far = _slab(o[1], v[1])
    return np.maximum(nearest - span, near), np.minimum(nearest + span, far)


def _cross_drum(o: np.ndarray, v: tuple[np.ndarray, ...], taper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    near, far = _slab(o[2], v[2])
    ratio = taper[:, 0]
    # A cone, x^2 + y^2 <= (middle + slope z)^2, expanded about the point of the ray nearest to its axis.
    middle, slope = (1 + ratio) / 2, (ratio - 1) / 2
    at = -(o[0] * v[0] + o[1] * v[1]) / np.maximum(v[0] * v[0] + v[1] * v[1], np.float32(1e-20))
    p, q, radius = o[0] + at * v[0], o[1] + at * v[1], middle + slope * (o[2] + at * v[2])
    gain = slope * v[2]
    a = v[0] * v[0] + v[1] * v[1] - gain * gain
    b = p * v[0] + q * v[1] - radius * gain
    c = p * p + q * q - radius * radius
    root = np.sqrt(b * b - a * c)
    early, late = (-b - root) / a, (-b + root) / a
    # A ray steeper than the side of the cone crosses it once: inwards if the cone widens ahead, else outwards.
    steep = a <= 0
    begin = np.where(steep & (gain < 0), np.float32(-np.inf), early)
    end = np.where(steep & (gain > 0), np.float32(np.inf), late)
    return np.maximum(near, at + begin), np.minimum(far, at + end)


# Intersection tests by kind, -1 for straight cuboids. Arguments are origins and directions in the axes of the unit
# shape and tapers; results are the parameters of entry and exit, with exit < entry or NaN for a miss.
_CROSSINGS = {-1: _cross_cuboid, BOX: _cross_box, DRUM: _cross_drum, BALL: _cross_ball, WHEEL: _cross_wheel}
