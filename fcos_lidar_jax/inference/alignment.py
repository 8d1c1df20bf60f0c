"""The way from the frame of a data set to the frame that a detector expects, and back."""

import dataclasses
import functools
import math
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.recorded import recorded_by
from fcos_lidar_jax.data.sweeps import about_z, turned
from fcos_lidar_jax.inference.tracks import to_world
from fcos_lidar_jax.sensors import Sensor, in_frame_of, turn_between
from fcos_lidar_jax.types import Detections

_SAME = 1e-9  # smaller angles and shifts are rounding


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
    yaw_rad: float | None = None  # rotation, counter-clockwise; None for the one between the sensors' headings

    @property
    def turn_rad(self) -> float:
        return turn_between(self.data, self.detector) if self.yaw_rad is None else self.yaw_rad

    @property
    def pose(self) -> np.ndarray | None:
        """f64[4, 4] from the frame of the data to the detector's; None if they are the same."""
        pose = about_z(self.turn_rad)
        shift = self.detector.origin_m - pose[:3, :3] @ self.data.origin_m
        pose[:3, 3] = np.where(np.abs(shift) < _SAME, 0, shift)
        return None if np.abs(pose - np.eye(4)).max() < _SAME else pose

    @property
    def inverse(self) -> "Alignment":
        return Alignment(self.detector, self.data, -self.turn_rad)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points f32[n, c] of the data in the detector's frame; other columns stay."""
        if (pose := self.pose) is None:
            return points
        moved = turned(points, pose)
        moved[:, :3] += pose[:3, 3]
        return moved

    def back(self, detections: Detections) -> Detections:
        """NumPy detections of the detector, with valid boxes in the frame of the data."""
        if (pose := self.inverse.pose) is None:
            return detections
        boxes, valid = np.array(detections.boxes), np.asarray(detections.valid)
        boxes[valid] = to_world(boxes[valid], pose)
        return dataclasses.replace(detections, boxes=boxes)

    def describe(self) -> str:
        """One line about what is done to the clouds; ``""`` for nothing."""
        if (pose := self.pose) is None:
            return ""
        turn = math.degrees(self.turn_rad)
        steps = [f"turned by {turn:g} degrees"] if turn else []
        if (shift := pose[:3, 3]).any():
            steps.append(f"shifted by ({', '.join(f'{v:.2f}' for v in shift)}) m")
        ahead = self.detector.forward_rad
        axes = {0.0: "x", 90.0: "y", 180.0: "-x", -180.0: "-x", -90.0: "-y"}
        axis = None if ahead is None else axes.get(round(math.degrees(ahead), 2))
        why = f": the detector expects {axis} ahead" if turn and axis else ""
        return f"clouds {' and '.join(steps)}, and boxes brought back{why}"


def align(
    detector: Sensor,
    recorded: Sensor | None = None,
    *,
    yaw_rad: float | None = None,
    intensity_scale: float | None = None,
) -> Alignment:
    """The alignment of points to a detector; read the points with its ``data``.

    Args:
        detector: sensor that the detector expects.
        recorded: gives heading, position and intensity scale of the data; None for those of the detector's sensor.
        yaw_rad: rotation from the data to the detector, counter-clockwise, instead of the one between headings.
        intensity_scale: factor from the intensity in files to the scale 0-255; None for the sensor's.

    >>> from fcos_lidar_jax.sensors import KITTI_HDL64E, NUSCENES_HDL32E
    >>> aligned = align(NUSCENES_HDL32E, KITTI_HDL64E)
    >>> aligned.data.num_rows, aligned.data.intensity_scale, round(aligned.turn_rad, 4)
    (32, 255.0, 1.5708)
    """
    if recorded is not None:
        data = in_frame_of(detector, recorded)
    else:  # the same place on the ego vehicle, in the axes of the data
        origin = np.array(detector.origin_m) @ about_z(yaw_rad or 0.0)[:3, :3]
        data = dataclasses.replace(detector, origin_m=tuple(origin.tolist()))
    if intensity_scale is not None:
        data = dataclasses.replace(data, intensity_scale=intensity_scale)
    return Alignment(data, detector, yaw_rad)


def align_files(
    paths: Iterable[Path],
    detector: Sensor,
    *,
    yaw_rad: float | None = None,
    intensity_scale: float | None = None,
) -> Alignment:
    """:func:`align` for point files, by the sensor that recorded them, which one line on standard error tells.

    Args:
        paths: point files, or folders of recordings, for :func:`~fcos_lidar_jax.data.recorded.recorded_by`.
        detector, yaw_rad, intensity_scale: as for :func:`align`.

    Raises:
        ValueError: different sensors recorded the files.
    """
    found: dict[Alignment, tuple[Path, Sensor | None]] = {}
    for path in {(path.parent, path.suffix): path for path in paths}.values():
        sensor = recorded_by(path)
        found[align(detector, sensor, yaw_rad=yaw_rad, intensity_scale=intensity_scale)] = path, sensor
    if len(found) > 1:
        files = " and ".join(f"{path} of {'any' if s is None else s.name}" for path, s in found.values())
        raise ValueError(f"sensor: got {files}, expected files of one sensor, or --data-sensor for all")
    [(aligned, (path, sensor))] = found.items()
    if sensor is not None and aligned.data != detector:
        told = f"{path if path.is_dir() else path.parent}: recorded by {sensor.name}, as the path tells"
        _tell_once(f"{told} (--data-sensor names another): intensities times {aligned.data.intensity_scale:g}")
    return aligned


@functools.cache
def _tell_once(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
