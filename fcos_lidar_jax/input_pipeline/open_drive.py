"""One function to open any drive; a table has one row per kind of recording."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fcos_lidar_jax.data.argoverse2 import argoverse2_drive, is_argoverse2_log
from fcos_lidar_jax.data.drives import Drive, folder_drive
from fcos_lidar_jax.data.kitti_raw import is_kitti_raw, kitti_raw_drive
from fcos_lidar_jax.data.nuscenes.reader import NuScenes
from fcos_lidar_jax.data.ros_bags import is_ros_bag, ros_bag_drive
from fcos_lidar_jax.input_pipeline.open import find_data_set
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class Recording:
    """A kind of drive."""

    title: str  # what it is, in messages
    recognises: Callable[[Path], bool] | None  # whether a path is of this kind; None if it does not show
    open: Callable[..., Drive]  # (path, sensor, **options) -> drive
    options: tuple[str, ...]


def _scene_drive(
    root: Path, _: Sensor, *, scene: str, version: str | None, keyframes: bool, num_sweeps: int, **options: Any
) -> Drive:
    """A scene of nuScenes; with ``keyframes``, the sweeps between them are only read if they are fused."""
    data = NuScenes(root, find_data_set(root, "nuscenes", version).version, **options)
    tokens = data.keyframe_tokens(scene)
    only_keyframes = keyframes and num_sweeps == 1
    skipped, number = (0, 0) if only_keyframes else data.skipped_sweeps(scene)
    notes = [f"skipped {skipped} of {number} sweeps, whose files are missing"] if skipped else []
    sweeps = data.drive(scene, keyframes=only_keyframes)
    return Drive(sweeps, at_us=frozenset(tokens) if keyframes else None, tokens=tokens, notes=notes)


FOLDER = Recording(
    "a folder of point files", None, folder_drive, ("poses", "columns", "dtype", "max_points", "viewpoint")
)
SCENE = Recording(
    "--data-root and --scene",
    None,
    _scene_drive,
    ("scene", "version", "index", "keyframes", "num_sweeps", "allow_missing_sweeps", "follow_links"),
)
RECORDINGS = (
    FOLDER,
    Recording(
        "a ROS recording (.bag, .mcap, .db3, metadata.yaml)",
        is_ros_bag,
        ros_bag_drive,
        ("poses", "topic", "odometry", "max_points"),
    ),
    Recording("a KITTI raw drive", is_kitti_raw, kitti_raw_drive, ("max_points",)),
    Recording("an Argoverse 2 log", is_argoverse2_log, argoverse2_drive, ("max_points",)),
    SCENE,
)


def find_recording(source: Path, *, scene: str | None = None, poses: Path | None = None) -> Recording:
    """The kind of a drive: a scene of the data set ``source``, or what ``source`` looks like.

    With a file of poses, recordings that have poses of their own are read as folders of point files. Refuses a
    missing source.
    """
    if scene is not None:
        return SCENE
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder")
    kinds = (kind for kind in RECORDINGS if kind.recognises is not None and kind.recognises(source))
    return next((kind for kind in kinds if poses is None or "poses" in kind.options), FOLDER)
