"""One scene of a synthetic data set: its point files and its rows of the tables."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation.lidar import SWEEP_S, Mount, sample_mount, scan
from fcos_lidar_jax.simulation.motion import travelled
from fcos_lidar_jax.simulation.nuscenes_tables import (
    CHANNEL,
    SCENE_TABLES,
    Row,
    attribute_of,
    link,
    pose_fields,
    token,
    visibility_of,
)
from fcos_lidar_jax.simulation.world import World, sample_labels, sample_world

SWEEPS_PER_KEYFRAME = 10
_OBJECTS = 150
"""Around a car that stands; one that drives meets more."""
_OBJECTS_PER_M = 0.6
_EPOCH_US = 1_700_000_000_000_000
_SCENE_APART_US = 600_000_000


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What decides every byte of a data set."""

    scenes: int
    seed: int
    keyframes: int
    sensor: Sensor
    rolling_shutter: bool
    version: str


@dataclasses.dataclass(frozen=True)
class Boxes:
    """The boxes of one keyframe in the global frame, as they are written."""

    translation: np.ndarray
    """f64[m, 3], millimetres exact."""
    size: np.ndarray
    """f64[m, 3]: width, length, height."""
    yaw: np.ndarray
    """f64[m], radians."""

    @property
    def upright(self) -> np.ndarray:
        """f64[m, 7]: ``x, y, z, l, w, h, yaw``."""
        return np.concatenate([self.translation, self.size[:, [1, 0, 2]], self.yaw[:, None]], axis=1)


def scene_name(index: int) -> str:
    """Name of a scene, counted from 0.

    >>> scene_name(0)
    'scene-0001'
    """
    return f"scene-{index + 1:04d}"


def render_scene(
    order: DatasetSpec, index: int, root: Path, advance: Callable[[int], object]
) -> dict[str, list[Row]]:
    """Write a scene's point files; the same bytes whatever the other scenes are.

    Args:
        order: the data set.
        index: of the scene.
        root: of the data set; ``samples/LIDAR_TOP`` and ``sweeps/LIDAR_TOP`` are there.
        advance: called with 1 after every sweep.

    Returns:
        the scene's rows, by table.

    Raises:
        OSError: a file cannot be written; the message names it.
    """
    rng = np.random.default_rng([order.seed, index])
    world = sample_scene(rng, order)
    mount = sample_mount(rng, order.sensor)
    placement = _draw_placement(rng)
    rows: dict[str, list[Row]] = {name: [] for name in SCENE_TABLES}
    scene = _begin(rows, order, index, mount)
    counts, shares, poses = [], [], []
    for number in range((order.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1):
        time_s = number * SWEEP_S
        noise = np.random.default_rng([order.seed, index, number])
        sweep = scan(world, order.sensor, mount, time_s, noise, rolling_shutter=order.rolling_shutter)
        keyframe = number % SWEEPS_PER_KEYFRAME == 0
        ego = _add_sweep(rows, order, scene, number, placement @ world.ego_pose(time_s))
        _write_points(root / rows["sample_data"][-1]["filename"], sweep.points)
        if keyframe:
            boxes = global_boxes(world, placement, time_s)
            to_global = _pose(ego) @ _pose(rows["calibrated_sensor"][0])
            xyz = sweep.points[sweep.returned, :3].astype(np.float64) @ to_global[:3, :3].T + to_global[:3, 3]
            counts.append(count_inside(xyz, boxes.upright))
            shares.append(sweep.seen_share)
            poses.append(boxes)
        advance(1)
    link(rows["sample_data"])
    link(rows["sample"])
    rows["scene"][0] |= {
        "nbr_samples": len(rows["sample"]),
        "first_sample_token": rows["sample"][0]["token"],
        "last_sample_token": rows["sample"][-1]["token"],
    }
    _add_annotations(rows, world, order, index, poses, np.array(counts), np.array(shares))
    return rows


def sample_scene(rng: np.random.Generator, order: DatasetSpec) -> World:
    """The world of one scene of a data set."""
    duration = (order.keyframes - 1) * SWEEPS_PER_KEYFRAME * SWEEP_S
    number = _OBJECTS + int(_OBJECTS_PER_M * 7 * duration)
    reach = min(80.0, 1.5 * order.sensor.limit_xy_m)
    return sample_world(
        rng, reach_m=reach, beyond_m=1.2 * reach, duration_s=duration, labels=sample_labels(rng, number)
    )


def _draw_placement(rng: np.random.Generator) -> np.ndarray:
    """The street's frame in the global one: turned about the vertical and moved in the plane, f64[4, 4]."""
    yaw = rng.uniform(-np.pi, np.pi)
    placement = np.eye(4)
    placement[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    placement[:2, 3] = rng.uniform(300, 2000, 2)
    return placement


def _begin(rows: dict[str, list[Row]], order: DatasetSpec, index: int, mount: Mount) -> Row:
    name = scene_name(index)
    key = (order.seed, name)
    log = {
        "token": token("log", *key),
        "logfile": f"sim-{order.seed}-{index + 1:04d}",
        "vehicle": "sim",
        "date_captured": "2023-11-14",
        "location": "synthetic-street",
    }
    scene = {
        "token": token("scene", *key),
        "log_token": log["token"],
        "nbr_samples": 0,
        "first_sample_token": "",
        "last_sample_token": "",
        "name": name,
        "description": "Simulated street",
    }
    carried = np.eye(4)
    carried[:3, :3], carried[:3, 3] = mount.rotation, mount.translation
    rows["log"].append(log)
    rows["scene"].append(scene)
    rows["calibrated_sensor"].append(
        {
            "token": token("calibrated_sensor", *key),
            "sensor_token": token("sensor", CHANNEL),
            **pose_fields(carried),
            "camera_intrinsic": [],
        }
    )
    return scene


def _add_sweep(rows: dict[str, list[Row]], order: DatasetSpec, scene: Row, number: int, ego: np.ndarray) -> Row:
    """Rows of a sweep, and of its keyframe where it is one; returns the pose's."""
    key = (order.seed, scene["name"])
    index = int(scene["name"].removeprefix("scene-"))
    timestamp = _EPOCH_US + index * _SCENE_APART_US + round(number * SWEEP_S * 1e6)
    keyframe = number % SWEEPS_PER_KEYFRAME == 0
    nearest = (number + SWEEPS_PER_KEYFRAME // 2) // SWEEPS_PER_KEYFRAME
    if keyframe:
        rows["sample"].append(
            {
                "token": token("sample", *key, number // SWEEPS_PER_KEYFRAME),
                "timestamp": timestamp,
                "prev": "",
                "next": "",
                "scene_token": scene["token"],
            }
        )
    data = token("sample_data", *key, number)
    pose = {"token": data, "timestamp": timestamp, **pose_fields(ego)}
    rows["ego_pose"].append(pose)
    folder = "samples" if keyframe else "sweeps"
    file = f"{rows['log'][0]['logfile']}__{CHANNEL}__{timestamp}.pcd.bin"
    rows["sample_data"].append(
        {
            "token": data,
            "sample_token": token("sample", *key, nearest),
            "ego_pose_token": data,
            "calibrated_sensor_token": rows["calibrated_sensor"][0]["token"],
            "timestamp": timestamp,
            "fileformat": "pcd",
            "is_key_frame": keyframe,
            "height": 0,
            "width": 0,
            "filename": f"{folder}/{CHANNEL}/{file}",
            "prev": "",
            "next": "",
        }
    )
    return pose


def _pose(row: Row) -> np.ndarray:
    """The 4x4 pose of a table's row."""
    return pose_matrix(np.array(row["rotation"]), np.array(row["translation"]))


def _write_points(path: Path, points: np.ndarray) -> None:
    try:
        path.write_bytes(points.tobytes())
    except OSError as error:
        path.unlink(missing_ok=True)  # rather than half a file
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def global_boxes(world: World, placement: np.ndarray, time_s: float) -> Boxes:
    """The boxes of all objects at a moment.

    Args:
        world: in the street's frame.
        placement: f64[4, 4], that frame in the global one.
        time_s: when.
    """
    pose, sizes = world.object_poses(time_s), world.traffic.sizes.round(3)
    center = pose[:, :3].copy()
    center[:, 2] += world.traffic.sizes[:, 2] / 2
    turn = np.arctan2(placement[1, 0], placement[0, 0])
    translation = (center @ placement[:3, :3].T + placement[:3, 3]).round(3)
    return Boxes(translation, sizes[:, [1, 0, 2]], pose[:, 3] + turn)


def _add_annotations(
    rows: dict[str, list[Row]],
    world: World,
    order: DatasetSpec,
    index: int,
    boxes: list[Boxes],
    counts: np.ndarray,
    shares: np.ndarray,
) -> None:
    """Annotate every object from the first keyframe to the last in which a point shows it."""
    key = (order.seed, scene_name(index))
    traffic = world.traffic
    times = np.arange(len(boxes)) * SWEEPS_PER_KEYFRAME * SWEEP_S
    speeds = np.array([travelled(traffic.motions, time_s)[1] for time_s in times])
    for k, (label, look) in enumerate(zip(traffic.labels, traffic.looks, strict=True)):
        shown = np.flatnonzero(counts[:, k])
        if not len(shown):
            continue
        instance = token("instance", *key, k)
        annotations = []
        for f in range(shown[0], shown[-1] + 1):
            attribute = attribute_of(
                NUSCENES_CLASSES[label], float(speeds[f, k]), rider=look.rider, parked=bool(traffic.parked[k])
            )
            yaw = boxes[f].yaw[k]
            annotations.append(
                {
                    "token": token("sample_annotation", *key, k, f),
                    "sample_token": rows["sample"][f]["token"],
                    "instance_token": instance,
                    "visibility_token": visibility_of(float(shares[f, k])),
                    "attribute_tokens": [token("attribute", attribute)] if attribute else [],
                    "translation": boxes[f].translation[k].tolist(),
                    "size": boxes[f].size[k].tolist(),
                    "rotation": [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))],
                    "prev": "",
                    "next": "",
                    "num_lidar_pts": int(counts[f, k]),
                    "num_radar_pts": 0,
                }
            )
        link(annotations)
        rows["sample_annotation"] += annotations
        rows["instance"].append(
            {
                "token": instance,
                "category_token": token("category", look.category),
                "nbr_annotations": len(annotations),
                "first_annotation_token": annotations[0]["token"],
                "last_annotation_token": annotations[-1]["token"],
            }
        )
