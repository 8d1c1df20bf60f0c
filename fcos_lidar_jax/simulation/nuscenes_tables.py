"""Rows of the official nuScenes tables: rows common to all data sets, and rows of one scene."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from fcos_lidar_jax.data.nuscenes.names import BICYCLE_RACK, CATEGORY_TO_CLASS
from fcos_lidar_jax.simulation.lidar import SWEEP_S

Row = dict[str, Any]

CATEGORIES = sorted(
    {
        *CATEGORY_TO_CLASS,
        BICYCLE_RACK,
        "animal",
        *(f"human.pedestrian.{kind}" for kind in ("personal_mobility", "stroller", "wheelchair")),
        *(f"movable_object.{kind}" for kind in ("debris", "pushable_pullable")),
        *(f"vehicle.emergency.{kind}" for kind in ("ambulance", "police")),
    }
)
"""Official categories; indices in the table start at 1."""
ATTRIBUTES = (
    *("vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "cycle.without_rider"),
    *("pedestrian.sitting_lying_down", "pedestrian.standing", "pedestrian.moving"),
)
VISIBILITIES = ("v0-40", "v40-60", "v60-80", "v80-100")
MAP_FILE = "maps/synthetic.png"
CHANNEL = "LIDAR_TOP"
SWEEPS_PER_KEYFRAME = 10
_LOG = {"vehicle": "sim", "date_captured": "2023-11-14", "location": "synthetic-street"}
_EPOCH_US = 1_700_000_000_000_000
_SCENE_APART_US = 600_000_000
_MOVING_MPS = 0.2


def token(*name: object) -> str:
    """Derive 32 hexadecimal digits from a name."""
    return hashlib.blake2b("/".join(map(str, name)).encode(), digest_size=16).hexdigest()


def fixed_tables(logs: list[str]) -> dict[str, list[Row]]:
    """Tables without scenes. All logs share one empty map, which the official reader requires."""
    return {
        "category": [
            {"token": token("category", name), "name": name, "description": "", "index": i}
            for i, name in enumerate(CATEGORIES, 1)
        ],
        "attribute": [{"token": token("attribute", n), "name": n, "description": ""} for n in ATTRIBUTES],
        "visibility": [{"token": str(i), "level": v, "description": ""} for i, v in enumerate(VISIBILITIES, 1)],
        "sensor": [{"token": token("sensor", CHANNEL), "channel": CHANNEL, "modality": "lidar"}],
        "map": [{"token": token("map"), "log_tokens": logs, "category": "semantic_prior", "filename": MAP_FILE}],
    }


def scene_name(index: int) -> str:
    """Name of a scene from its index, starting at 0."""
    return f"scene-{index + 1:04d}"


def sweep_file(seed: int, index: int, number: int) -> str:
    """Path of the point file of a sweep in its data set."""
    folder = "sweeps" if number % SWEEPS_PER_KEYFRAME else "samples"
    return f"{folder}/{CHANNEL}/{_logfile(seed, index)}__{CHANNEL}__{_timestamp_us(index, number)}.pcd.bin"


def scene_rows(seed: int, index: int, mount: Row, ego_poses: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of a scene without its objects, from the seed of the data set and the index of the scene.

    ``mount``, the pose of the sensor in the ego frame, and ``ego_poses``, one per sweep, are from
    :func:`pose_fields`; the first and the last sweep are keyframes.
    """
    key = (seed, scene_name(index))
    log, scene, calibration = (token(table, *key) for table in ("log", "scene", "calibrated_sensor"))
    numbers = range(len(ego_poses))
    times = [_timestamp_us(index, number) for number in numbers]
    data = [token("sample_data", *key, number) for number in numbers]
    samples = [token("sample", *key, i) for i in range(len(numbers[::SWEEPS_PER_KEYFRAME]))]
    return {
        "log": [{"token": log, "logfile": _logfile(seed, index), **_LOG}],
        "scene": [
            {
                "token": scene,
                "log_token": log,
                "nbr_samples": len(samples),
                "first_sample_token": samples[0],
                "last_sample_token": samples[-1],
                "name": scene_name(index),
                "description": "Simulated street",
            }
        ],
        "calibrated_sensor": [
            {"token": calibration, "sensor_token": token("sensor", CHANNEL), **mount, "camera_intrinsic": []}
        ],
        "sample": [
            {"token": sample, "timestamp": time_us, **_neighbours(samples, i), "scene_token": scene}
            for i, (sample, time_us) in enumerate(zip(samples, times[::SWEEPS_PER_KEYFRAME], strict=True))
        ],
        "sample_data": [
            {
                "token": data[number],
                "sample_token": samples[(number + SWEEPS_PER_KEYFRAME // 2) // SWEEPS_PER_KEYFRAME],
                "ego_pose_token": data[number],
                "calibrated_sensor_token": calibration,
                "timestamp": times[number],
                "fileformat": "pcd",
                "is_key_frame": number % SWEEPS_PER_KEYFRAME == 0,
                "height": 0,
                "width": 0,
                "filename": sweep_file(seed, index, number),
                **_neighbours(data, number),
            }
            for number in numbers
        ],
        "ego_pose": [{"token": data[i], "timestamp": times[i], **ego_poses[i]} for i in numbers],
    }


def object_rows(
    seed: int,
    index: int,
    categories: Sequence[str],
    boxes: np.ndarray,
    attributes: Sequence[Sequence[str | None]],
    seen_shares: np.ndarray,
    counts: np.ndarray,
) -> dict[str, list[Row]]:
    """Rows of the objects of a scene, annotated from the first to the last keyframe in which they have points.

    Args:
        categories: [m], categories of the objects.
        boxes: f64[k, m, 7], boxes ``x, y, z, l, w, h, yaw`` in the global frame, per keyframe.
        attributes: [k][m], attribute names, None for objects without an attribute.
        seen_shares: f64[k, m], share of the rays towards each object that reach it.
        counts: i32[k, m], number of points in each box.
    """
    key = (seed, scene_name(index))
    rows: dict[str, list[Row]] = {"instance": [], "sample_annotation": []}
    for number, category in enumerate(categories):
        if not len(shown := np.flatnonzero(counts[:, number])):
            continue
        instance = token("instance", *key, number)
        tokens = [token("sample_annotation", *key, number, i) for i in range(shown[0], shown[-1] + 1)]
        rows["instance"].append(
            {
                "token": instance,
                "category_token": token("category", category),
                "nbr_annotations": len(tokens),
                "first_annotation_token": tokens[0],
                "last_annotation_token": tokens[-1],
            }
        )
        for i, annotation in enumerate(tokens, shown[0]):
            box, attribute = boxes[i, number], attributes[i][number]
            rows["sample_annotation"].append(
                {
                    "token": annotation,
                    "sample_token": token("sample", *key, i),
                    "instance_token": instance,
                    "visibility_token": visibility_of(seen_shares[i, number]),
                    "attribute_tokens": [token("attribute", attribute)] if attribute else [],
                    "translation": box[:3].tolist(),
                    "size": box[[4, 3, 5]].tolist(),
                    "rotation": [float(np.cos(box[6] / 2)), 0.0, 0.0, float(np.sin(box[6] / 2))],
                    **_neighbours(tokens, i - shown[0]),
                    "num_lidar_pts": int(counts[i, number]),
                    "num_radar_pts": 0,
                }
            )
    return rows


def attribute_of(name: str, speed_mps: float, *, rider: bool, parked: bool) -> str | None:
    """Attribute of an object, None for traffic cones and barriers."""
    moves = speed_mps > _MOVING_MPS
    if name in ("traffic_cone", "barrier"):
        return None
    if name == "pedestrian":
        return "pedestrian.moving" if moves else "pedestrian.standing"
    if name in ("motorcycle", "bicycle"):
        return "cycle.with_rider" if rider else "cycle.without_rider"
    return "vehicle.moving" if moves else "vehicle.parked" if parked else "vehicle.stopped"


def visibility_of(share: float) -> str:
    """Token of the visibility level of an object, from the share of rays that reach it."""
    return str(1 + int(np.searchsorted((0.4, 0.6, 0.8), share, side="right")))


def pose_fields(pose: np.ndarray) -> Row:
    """Table fields of a 4x4 pose: translation and rotation (w, x, y, z)."""
    from scipy.spatial.transform import Rotation  # SciPy takes long to import

    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return {"translation": pose[:3, 3].tolist(), "rotation": quaternion.tolist()}


def _logfile(seed: int, index: int) -> str:
    return f"sim-{seed}-{index + 1:04d}"


def _timestamp_us(index: int, number: int) -> int:
    return _EPOCH_US + (index + 1) * _SCENE_APART_US + round(number * SWEEP_S * 1e6)


def _neighbours(tokens: Sequence[str], i: int) -> Row:
    return {"prev": tokens[i - 1] if i else "", "next": tokens[i + 1] if i + 1 < len(tokens) else ""}
