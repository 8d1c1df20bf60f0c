"""A small simulated data set in the layout of KITTI, and the texts of its files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.data.box_geometry import count_inside
from fcos_lidar_jax.data.kitti import IMAGE_SIZE, in_image
from fcos_lidar_jax.sensors import KITTI_HDL64E, Sensor
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

# Camera axes (right, down, forward) in the Velodyne's (forward, left, up).
AXES = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
SHIFT = np.array([0.02, -0.07, -0.29])
P2 = np.array([[718.0, 0, 606, 44], [0, 718, 178, 0.2], [0, 0, 1, 0.003]])
MOUNTED = Rotation.from_euler("xyz", [0.7, -0.4, 0.5], degrees=True).as_matrix() @ AXES
RECTIFIED = Rotation.from_euler("xyz", [0.2, 0.3, -0.3], degrees=True).as_matrix()

_TYPES = {"car": "Car", "truck": "Truck", "bus": "Tram", "trailer": "Misc", "construction_vehicle": "Van"}
_TYPES |= {"pedestrian": "Pedestrian", "motorcycle": "Cyclist", "bicycle": "Cyclist"}


def calibration_text(mounted=MOUNTED, rectified=RECTIFIED) -> str:
    imu, velo = np.eye(4)[:3], np.column_stack([mounted, SHIFT])
    matrices = {"P0": P2, "P2": P2, "R0_rect": rectified, "Tr_velo_to_cam": velo, "Tr_imu_to_velo": imu}
    lines = (f"{name}: " + " ".join(f"{v:.12e}" for v in matrix.flat) for name, matrix in matrices.items())
    return "\n".join(lines) + "\n\n"


def label_text(box, kind="Car", mounted=MOUNTED, rectified=RECTIFIED) -> str:
    """Line of a label file, computed from the centre and nose of the box in camera coordinates."""

    def seen(xyz):
        return rectified @ (mounted @ np.asarray(xyz) + SHIFT)

    x, y, z, l, w, h, yaw = box[:7]
    centre, nose = seen([x, y, z]), seen([x + np.cos(yaw), y + np.sin(yaw), z])
    turn = -np.arctan2(nose[2] - centre[2], nose[0] - centre[0])
    numbers = (h, w, l, centre[0], centre[1] + h / 2, centre[2], turn)
    return f"{kind} 0.00 0 0.0 1.0 2.0 3.0 4.0 " + " ".join(f"{v:.9f}" for v in numbers) + "\n"


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def make_kitti(
    root: Path, *, train: int = 4, val: int = 2, sensor: Sensor = KITTI_HDL64E, first_seed: int = 0
) -> Path:
    """Write frames ``000000``, ``000001`` ... with splits ``train`` and ``val``; x forward, y left.

    Objects with at least five points in the image are labelled.
    """
    frames = SimulatedFrames(sensor, train + val, first_seed, num_objects=30, reach_m=15.0)
    names = [f"{i:06d}" for i in range(len(frames))]
    training = root / "training"
    (training / "velodyne").mkdir(parents=True)
    for split, chosen in (("train", names[:train]), ("val", names[train:])):
        write(root / "ImageSets" / f"{split}.txt", "\n".join(chosen) + "\n")
    to_image = P2 @ np.vstack([np.column_stack([RECTIFIED @ MOUNTED, RECTIFIED @ SHIFT]), [0, 0, 0, 1]])
    for i, name in enumerate(names):
        frame = frames.frame(i)
        points = frame.points[:, [1, 0, 2, 3]] * np.array([1, -1, 1, 1 / sensor.intensity_scale], np.float32)
        boxes = frame.boxes[:, [1, 0, 2, 3, 4, 5, 6]] * np.array([1, -1, 1, 1, 1, 1, 1])
        boxes[:, 6] -= np.pi / 2
        shown = count_inside(points[in_image(points, to_image, IMAGE_SIZE)], boxes) >= 5
        kinds = [_TYPES.get(frames.classes[label]) for label in frame.labels]
        lines = [label_text(b, k) for b, k, s in zip(boxes, kinds, shown, strict=True) if k is not None and s]
        lines.append("DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n")
        points.astype(np.float32).tofile(training / "velodyne" / f"{name}.bin")
        write(training / "label_2" / f"{name}.txt", "".join(lines))
        write(training / "calib" / f"{name}.txt", calibration_text())
    return root


def write_raw_drive(day: Path, clouds: Sequence[np.ndarray], poses: Sequence[str]) -> Path:
    """Write a raw recording, whose sweeps are a tenth of a second apart, with the calibration of its day."""
    drive = day / "drive"
    (drive / "velodyne_points" / "data").mkdir(parents=True)
    for index, (points, words) in enumerate(zip(clouds, poses, strict=True)):
        points.astype(np.float32).tofile(drive / f"velodyne_points/data/{index:010d}.bin")
        write(drive / f"oxts/data/{index:010d}.txt", words)
    stamps = (f"2011-09-26 13:02:25.{5 + index}94360375\n" for index in range(len(clouds)))
    write(drive / "velodyne_points" / "timestamps.txt", "".join(stamps))
    write(day / "calib_imu_to_velo.txt", "calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    return drive
