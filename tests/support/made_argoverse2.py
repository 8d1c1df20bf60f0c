"""Small simulated logs in the official layout of Argoverse 2."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import feather
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.sensors import ARGOVERSE2, Sensor
from fcos_lidar_jax.simulation.frames import boxes_in_sensor_frame
from fcos_lidar_jax.simulation.lidar import sample_mount, scan
from fcos_lidar_jax.simulation.world import sample_world

START_NS, STEP_NS = 315_966_265_259_836_000, 100_200_000
CATEGORIES = (
    *("REGULAR_VEHICLE", "BOX_TRUCK", "BUS", "VEHICULAR_TRAILER", "LARGE_VEHICLE", "PEDESTRIAN", "MOTORCYCLE"),
    *("BICYCLE", "CONSTRUCTION_CONE", "BOLLARD"),
)
"""Categories of the simulated classes, in their order."""


def write_table(file: Path, columns: dict[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), str(file))


def write_sweep(log: Path, time_ns: int, points: np.ndarray) -> None:
    """Write points ``x, y, z, intensity, laser`` as half floats and bytes, like the published files."""
    columns = {name: points[:, i].astype(np.float16) for i, name in enumerate("xyz")}
    columns |= {"intensity": points[:, 3].astype(np.uint8), "laser_number": points[:, 4].astype(np.uint8)}
    columns["offset_ns"] = np.linspace(0, STEP_NS, len(points)).astype(np.int32)
    write_table(log / "sensors" / "lidar" / f"{time_ns}.feather", columns)


def pose_columns(matrices: np.ndarray) -> dict[str, np.ndarray]:
    quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(scalar_first=True)
    columns = {name: quaternions[:, i] for i, name in enumerate(("qw", "qx", "qy", "qz"))}
    return columns | {name: matrices[:, i, 3] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))}


def write_poses(log: Path, time_ns: np.ndarray, matrices: np.ndarray) -> None:
    write_table(log / "city_SE3_egovehicle.feather", {"timestamp_ns": time_ns, **pose_columns(matrices)})


def write_boxes(log: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows with ``time_ns``, ``track``, ``category``, ``box`` (x, y, z, l, w, h, yaw) and ``count``."""
    boxes = np.array([row["box"] for row in rows], np.float64).reshape(-1, 7)
    matrices = np.tile(np.eye(4), (len(boxes), 1, 1))
    matrices[:, :3, :3] = Rotation.from_euler("z", boxes[:, 6:7]).as_matrix()
    matrices[:, :3, 3] = boxes[:, :3]
    columns = {
        "timestamp_ns": np.array([row["time_ns"] for row in rows], np.int64),
        "track_uuid": [str(row["track"]) for row in rows],
        "category": [row["category"] for row in rows],
        **{name: boxes[:, 3 + i] for i, name in enumerate(("length_m", "width_m", "height_m"))},
        **pose_columns(matrices),
        "num_interior_pts": np.array([row["count"] for row in rows], np.int64),
    }
    write_table(log / "annotations.feather", columns)


def make_log(log: Path, seed: int, *, sweeps: int = 4, sensor: Sensor = ARGOVERSE2) -> Path:
    """A drive through a simulated street. The ego vehicle's x axis points to its right here, not forward."""
    rng = np.random.default_rng([seed, 0xA2])
    seconds = STEP_NS * 1e-9
    labels = rng.permutation(np.resize(np.arange(len(NUSCENES_CLASSES)), 20))
    world = sample_world(rng, reach_m=20, beyond_m=40, duration_s=sweeps * seconds, labels=labels, level=True)
    mount = sample_mount(rng, sensor, level=True)
    city = np.eye(4)
    city[:3, :3] = Rotation.from_euler("zyx", [rng.uniform(-3, 3), 0.01, -0.02]).as_matrix()
    city[:3, 3] = 700, 1300, -24
    rows = []
    for i in range(sweeps):
        time_ns = START_NS + STEP_NS * i
        scanned = scan(world, sensor, mount, i * seconds, rng)
        points = scanned.points[scanned.returned]
        points[:, 4] = sensor.num_rows - 1 - points[:, 4]
        write_sweep(log, time_ns, points)
        boxes = boxes_in_sensor_frame(world, world.ego_pose(i * seconds) @ mount, i * seconds)
        counts = count_inside(points, boxes)
        rows += [
            {"time_ns": time_ns, "track": k, "category": CATEGORIES[label], "box": box[:7], "count": count}
            for k, (label, box, count) in enumerate(zip(world.traffic.labels, boxes, counts, strict=True))
            if count > 0
        ]
    halves = np.arange(2 * sweeps)
    poses = np.array([city @ (world.ego_pose(i * seconds / 2) @ mount) for i in halves])
    write_poses(log, START_NS + STEP_NS // 2 * halves, poses)
    write_boxes(log, rows)
    return log


def make_argoverse2(
    root: Path, *, train: int = 1, val: int = 1, sweeps: int = 4, sensor: Sensor = ARGOVERSE2, first_seed: int = 0
) -> Path:
    """Write logs in the splits ``train`` and ``val``."""
    for split, first, number in (("train", first_seed, train), ("val", first_seed + train, val)):
        for seed in range(first, first + number):
            make_log(root / split / f"log-{seed:04d}", seed, sweeps=sweeps, sensor=sensor)
    return root
