"""The way from the frame of a data set to the frame that a detector expects, and back."""

import dataclasses
import math

import numpy as np

from fcos_lidar_jax.data.sweeps import about_z, turned
from fcos_lidar_jax.inference.tracks import to_world
from fcos_lidar_jax.sensors import Sensor, turn_between
from fcos_lidar_jax.types import Detections


@dataclasses.dataclass(frozen=True)
class Alignment:
    """A rotation about z and a shift from the points of one sensor to the frame of a detector's sensor.

    >>> from fcos_lidar_jax.sensors import KITTI_HDL64E, NUSCENES_HDL32E
    >>> aligned = Alignment(KITTI_HDL64E, NUSCENES_HDL32E)
    >>> aligned.points(np.array([[10, 0, -1, 200, 0]], np.float32)).round(3).tolist()
    [[0.0, 10.0, -1.0, 200.0, 0.0]]
    """

    data: Sensor  # sensor that recorded the points
    detector: Sensor  # sensor that the detector expects

    @property
    def pose(self) -> np.ndarray | None:
        """f64[4, 4] from the frame of the data to the detector's; None if they are the same."""
        pose = about_z(turn_between(self.data, self.detector))
        pose[:3, 3] = self.detector.origin_m - pose[:3, :3] @ self.data.origin_m
        return None if np.abs(pose - np.eye(4)).max() < 1e-9 else pose

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points f32[n, c] of the data in the detector's frame; other columns stay."""
        if (pose := self.pose) is None:
            return points
        moved = turned(points, pose)
        moved[:, :3] += pose[:3, 3]
        return moved

    def back(self, detections: Detections) -> Detections:
        """NumPy detections of the detector, with valid boxes in the frame of the data."""
        if (pose := self.pose) is None:
            return detections
        boxes, valid = np.array(detections.boxes), np.asarray(detections.valid)
        boxes[valid] = to_world(boxes[valid], np.linalg.inv(pose))
        return dataclasses.replace(detections, boxes=boxes)

    def describe(self) -> str:
        """One line about what is done to the clouds; ``""`` for nothing."""
        if (pose := self.pose) is None:
            return ""
        turn = math.degrees(turn_between(self.data, self.detector))
        steps = [f"turned by {turn:g} degrees"] if turn else []
        if (shift := pose[:3, 3]).any():
            steps.append(f"shifted by ({', '.join(f'{v:.2f}' for v in shift)}) m")
        ahead = self.detector.forward_rad
        axes = {0.0: "x", 90.0: "y", 180.0: "-x", -180.0: "-x", -90.0: "-y"}
        axis = None if ahead is None else axes.get(round(math.degrees(ahead), 2))
        why = f": the detector expects {axis} ahead" if turn and axis else ""
        return f"clouds {' and '.join(steps)}, and boxes brought back{why}"
