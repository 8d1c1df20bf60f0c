"""Rows of the official nuScenes tables: tokens, the tables that never change, and those of one scene."""

import hashlib
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

Row = dict[str, Any]

SCENE_TABLES = (
    "log",
    "scene",
    "calibrated_sensor",
    "sample",
    "sample_data",
    "ego_pose",
    "instance",
    "sample_annotation",
)
"""Tables of which every scene has rows of its own."""

CATEGORIES = (
    "animal",
    "human.pedestrian.adult",
    "human.pedestrian.child",
    "human.pedestrian.construction_worker",
    "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer",
    "human.pedestrian.stroller",
    "human.pedestrian.wheelchair",
    "movable_object.barrier",
    "movable_object.debris",
    "movable_object.pushable_pullable",
    "movable_object.trafficcone",
    "static_object.bicycle_rack",
    "vehicle.bicycle",
    "vehicle.bus.bendy",
    "vehicle.bus.rigid",
    "vehicle.car",
    "vehicle.construction",
    "vehicle.emergency.ambulance",
    "vehicle.emergency.police",
    "vehicle.motorcycle",
    "vehicle.trailer",
    "vehicle.truck",
)
"""The official categories; their index counts from 1."""

ATTRIBUTES = (
    "vehicle.moving",
    "vehicle.stopped",
    "vehicle.parked",
    "cycle.with_rider",
    "cycle.without_rider",
    "pedestrian.sitting_lying_down",
    "pedestrian.standing",
    "pedestrian.moving",
)
VISIBILITIES = ("v0-40", "v40-60", "v60-80", "v80-100")
MAP_FILE = "maps/synthetic.png"
CHANNEL = "LIDAR_TOP"
_MOVING_MPS = 0.2


def token(*name: object) -> str:
    """32 hexadecimal digits that follow from a name.

    >>> token("sample", 0, 1)
    '19be9df9c5a728e4f1980077f6da86b8'
    """
    return hashlib.blake2b("/".join(map(str, name)).encode(), digest_size=16).hexdigest()


def fixed_tables() -> dict[str, list[Row]]:
    """The tables that are the same in every synthetic data set."""
    return {
        "category": [
            {"token": token("category", name), "name": name, "description": "", "index": i + 1}
            for i, name in enumerate(CATEGORIES)
        ],
        "attribute": [{"token": token("attribute", n), "name": n, "description": ""} for n in ATTRIBUTES],
        "visibility": [
            {"token": str(i + 1), "level": level, "description": ""} for i, level in enumerate(VISIBILITIES)
        ],
        "sensor": [{"token": token("sensor", CHANNEL), "channel": CHANNEL, "modality": "lidar"}],
    }


def map_table(logs: list[str]) -> list[Row]:
    """One map for all logs, as the official reader wants it; there is nothing on it."""
    return [
        {"token": token("map"), "log_tokens": logs, "category": "semantic_prior", "filename": MAP_FILE},
    ]


def attribute_of(name: str, speed_mps: float, *, rider: bool, parked: bool) -> str | None:
    """Attribute of an object of a class, None for cones and barriers.

    >>> attribute_of("car", 3.0, rider=False, parked=False)
    'vehicle.moving'
    """
    moves = speed_mps > _MOVING_MPS
    if name in ("traffic_cone", "barrier"):
        return None
    if name == "pedestrian":
        return "pedestrian.moving" if moves else "pedestrian.standing"
    if name in ("motorcycle", "bicycle"):
        return "cycle.with_rider" if rider else "cycle.without_rider"
    return "vehicle.moving" if moves else "vehicle.parked" if parked else "vehicle.stopped"


def visibility_of(share: float) -> str:
    """Token of the visibility level of an object of which this share of the rays is free.

    >>> [visibility_of(share) for share in (0.0, 0.5, 0.7, 1.0)]
    ['1', '2', '3', '4']
    """
    return str(1 + int(np.searchsorted((0.4, 0.6, 0.8), share, side="right")))


def pose_fields(pose: np.ndarray) -> Row:
    """Translation and rotation (w, x, y, z) of a 4x4 pose, as tables hold them."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return {"translation": pose[:3, 3].tolist(), "rotation": quaternion.tolist()}


def link(rows: list[Row]) -> None:
    """Set ``prev`` and ``next`` of rows in the order of time."""
    for i, row in enumerate(rows):
        row["prev"] = rows[i - 1]["token"] if i else ""
        row["next"] = rows[i + 1]["token"] if i + 1 < len(rows) else ""
