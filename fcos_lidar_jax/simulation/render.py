"""Scenes of a synthetic data set: point files and table rows."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.data.sweeps import about_z
from fcos_lidar_jax.files import naming
from fcos_lidar_jax.geometry import pose_matrix
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.simulation import nuscenes_tables as tables
from fcos_lidar_jax.simulation.lidar import SWEEP_S, sample_mount, scan
from fcos_lidar_jax.simulation.motion import travelled
from fcos_lidar_jax.simulation.nuscenes_tables import SWEEPS_PER_KEYFRAME, Row, pose_fields
from fcos_lidar_jax.simulation.streets import CITY, Streets
from fcos_lidar_jax.simulation.world import World, sample_labels, sample_world

_OBJECTS = 150  # number of objects around a parked ego vehicle
_OBJECTS_PER_M = 0.6  # additional objects per metre driven


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """Specification that determines all bytes of a data set."""

    scenes: int
    seed: int
    keyframes: int  # per scene
    sensor: Sensor
    rolling_shutter: bool
    version: str  # folder of the tables
    streets: Streets = CITY

    @property
    def sweeps(self) -> int:
        return (self.keyframes - 1) * SWEEPS_PER_KEYFRAME + 1


def render_scene(spec: DatasetSpec, index: int, root: Path, advance: Callable[[], object]) -> dict[str, list[Row]]:
    """Write the point files of a scene. Their bytes do not depend on the other scenes.

    The folder of the data set has folders ``samples/LIDAR_TOP`` and ``sweeps/LIDAR_TOP``; ``advance`` is called
    after each sweep. Returns the rows of the scene by table. Each object is annotated from the first to the last
    keyframe in which it has points.
    """
    rng = np.random.default_rng([spec.seed, index])
    world = sample_scene(rng, spec)
    traffic = world.traffic
    sensor_to_ego = sample_mount(rng, spec.sensor, streets=spec.streets)
    street_to_global = about_z(rng.uniform(-np.pi, np.pi))
    street_to_global[:2, 3] = rng.uniform(300, 2000, 2)
    mount, egos = pose_fields(sensor_to_ego), []
    boxes, counts, shares, attributes = [], [], [], []
    for number in range(spec.sweeps):
        time_s = number * SWEEP_S
        noise = np.random.default_rng([spec.seed, index, number])
        sweep = scan(world, spec.sensor, sensor_to_ego, time_s, noise, rolling_shutter=spec.rolling_shutter)
        with naming(file := root / tables.sweep_file(spec.seed, index, number)):
            file.write_bytes(sweep.points.tobytes())
        egos.append(pose_fields(street_to_global @ world.ego_pose(time_s)))
        if number % SWEEPS_PER_KEYFRAME == 0:
            boxes.append(_global_boxes(world, street_to_global, time_s))
            to_global = _pose(egos[-1]) @ _pose(mount)
            xyz = sweep.points[sweep.returned, :3].astype(np.float64) @ to_global[:3, :3].T + to_global[:3, 3]
            counts.append(count_inside(xyz, boxes[-1]))
            shares.append(sweep.seen_share)
            _, speeds = travelled(traffic.motions, time_s)
            names = [NUSCENES_CLASSES[label] for label in traffic.labels]
            objects = zip(names, speeds, traffic.models, traffic.parked, strict=True)
            attributes.append([tables.attribute_of(n, v, rider=m.rider, parked=p) for n, v, m, p in objects])
        advance()
    arrays = np.array(boxes), attributes, np.array(shares), np.array(counts)
    objects = tables.object_rows(spec.seed, index, [model.category for model in traffic.models], *arrays)
    return tables.scene_rows(spec.seed, index, mount, egos) | objects


def sample_scene(rng: np.random.Generator, spec: DatasetSpec) -> World:
    """Sample the world of a scene."""
    duration = (spec.sweeps - 1) * SWEEP_S
    crowd = np.clip(rng.spawn(1)[0].lognormal(-0.6, 0.5), 0.2, 1.5) if spec.streets.setting else 1
    labels = sample_labels(rng, int(crowd * (_OBJECTS + int(_OBJECTS_PER_M * 7 * duration))))
    reach = min(80.0, 1.5 * spec.sensor.limit_xy_m)
    return sample_world(
        rng, reach_m=reach, beyond_m=1.2 * reach, duration_s=duration, labels=labels, streets=spec.streets
    )


def _pose(row: Row) -> np.ndarray:
    return pose_matrix(np.array(row["rotation"]), np.array(row["translation"]))


def _global_boxes(world: World, street_to_global: np.ndarray, time_s: float) -> np.ndarray:
    """Boxes ``x, y, z, l, w, h, yaw`` of all objects, f64[m, 7], rounded to millimetres as in the tables."""
    pose, sizes = world.object_poses(time_s), world.traffic.sizes
    center = pose[:, :3] + sizes * (0, 0, 0.5)
    turn = np.arctan2(street_to_global[1, 0], street_to_global[0, 0])
    center = (center @ street_to_global[:3, :3].T + street_to_global[:3, 3]).round(3)
    return np.concatenate([center, sizes.round(3), pose[:, 3:] + turn], axis=1)
