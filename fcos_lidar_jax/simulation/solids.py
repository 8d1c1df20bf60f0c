"""Primitives of the simulated world, as rows of one structured array.

A solid is a unit shape that is scaled by half extents, sheared along its own x with height, rotated about the
vertical and translated. Each row of :data:`SOLID` is one opaque or porous solid.
"""

import numpy as np

BOX, DRUM, BALL, WHEEL = range(4)
"""Kinds: a cuboid that may taper towards the top, an upright elliptic cylinder that may taper down to a cone, an
ellipsoid, and a cylinder with its axis across the heading."""

SOLID = np.dtype(
    [
        ("kind", np.int8),
        ("center", np.float64, 3),  # metres
        ("half", np.float64, 3),  # half extents along the solid's x, y, z, metres
        ("yaw", np.float64),  # radians, counter-clockwise from +x
        ("lean", np.float64),  # metres along the solid's x per metre of height
        ("taper", np.float64, 2),  # ratio of top to base along x and y; drums use the first
        ("albedo", np.float64),  # 0-1
        ("density", np.float64),  # stopped rays per metre inside, inf for opaque solids
        ("gloss", np.float64),  # share of grazing rays that are reflected away, above 1 for glass
        ("owner", np.int32),  # index of the object, -1 for scenery, -2 for the ego vehicle
    ]
)

SCENERY, EGO = -1, -2


def make_solids(kind: int, center: object, half: object, **fields: object) -> np.ndarray:
    """Create solids [s] of one kind. All fields broadcast; ``center`` and ``half`` are [..., 3].

    The defaults of the other fields describe upright, untapered, opaque scenery with albedo 0.3.
    """
    center = np.atleast_2d(np.asarray(center, np.float64))
    solids = np.zeros(len(center), SOLID)
    defaults = {"taper": 1.0, "albedo": 0.3, "density": np.inf, "owner": SCENERY}
    for name, value in {"kind": kind, "center": center, "half": half, **defaults, **fields}.items():
        solids[name] = value
    return solids


def place_solids(solids: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform solids from local frames to the world frame.

    Args:
        solids: [s].
        pose: f64[s, 4], ``x, y, z, yaw`` of the frame of each solid, or [4] for a common frame.
    """
    pose = np.broadcast_to(pose, (len(solids), 4))
    placed = solids.copy()
    c, s = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    x, y, z = solids["center"].T
    placed["center"] = np.stack([c * x - s * y, s * x + c * y, z], axis=1) + pose[:, :3]
    placed["yaw"] = solids["yaw"] + pose[:, 3]
    return placed


def enclosing(solids: np.ndarray) -> np.ndarray:
    """Half extents f64[s, 3] of a cuboid that encloses each solid, including lean and taper."""
    half, taper = solids["half"].copy(), solids["taper"].copy()
    taper[solids["kind"] == DRUM, 1] = taper[solids["kind"] == DRUM, 0]
    half[:, :2] *= np.maximum(taper, 1)
    half[:, 0] += np.abs(solids["lean"]) * half[:, 2]
    return half


def corners(solids: np.ndarray) -> np.ndarray:
    """Corners f64[s, 8, 3] of the cuboids of :func:`enclosing`."""
    half = enclosing(solids)
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    c, s = np.cos(solids["yaw"])[:, None], np.sin(solids["yaw"])[:, None]
    x, y, z = np.moveaxis(half[:, None] * signs, -1, 0)
    return solids["center"][:, None] + np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def unit_map(solids: np.ndarray) -> np.ndarray:
    """Matrices f64[s, 3, 3] from offsets to the centre in world axes to the axes of the unit shape."""
    c, s = np.cos(solids["yaw"]), np.sin(solids["yaw"])
    maps = np.zeros((len(solids), 3, 3))
    maps[:, 0] = np.stack([c, s, -solids["lean"]], axis=1)
    maps[:, 1, 0], maps[:, 1, 1], maps[:, 2, 2] = -s, c, 1
    return maps / solids["half"][:, :, None]
