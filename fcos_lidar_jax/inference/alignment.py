"""Transformation from the frame of a data set to the frame that a detector expects, and back."""

import dataclasses
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np

from fcos_lidar_jax.data.box_geometry import transform_boxes
from fcos_lidar_jax.data.cloud_policy import sensor_mismatch
from fcos_lidar_jax.data.folder import sensor_file
from fcos_lidar_jax.data.recorded import check_scale, recorded_by
from fcos_lidar_jax.data.sweeps import about_z
from fcos_lidar_jax.geometry import wrap_angle
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import Sensor, in_frame_of, turn_between
from fcos_lidar_jax.types import Detections

_SAME = 1e-9  # smaller angles and shifts are rounding


@dataclasses.dataclass(frozen=True)
class Alignment:
    """A rotation about z and a shift from the points of one sensor to the frame of a detector's sensor."""

    data: Sensor  # sensor that recorded the points
    detector: Sensor  # sensor that the detector expects
    yaw_rad: float | None = None  # rotation, counter-clockwise; None for the one between the sensors' headings
    notes: tuple[str, ...] = ()  # lines for :meth:`tell_notes`

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
        moved = np.array(points)
        with np.errstate(over="ignore", invalid="ignore"):  # the cloud policy removes rows that are not finite
            moved[:, :3] = moved[:, :3] @ pose[:3, :3].T
        moved[:, :3] += pose[:3, 3]
        return moved

    def back(self, detections: Detections) -> Detections:
        """NumPy detections of the detector, with valid boxes in the frame of the data."""
        if (pose := self.inverse.pose) is None:
            return detections
        boxes, valid = np.array(detections.boxes), np.asarray(detections.valid)
        boxes[valid] = transform_boxes(boxes[valid], pose)
        boxes[valid, 6] = wrap_angle(boxes[valid, 6])  # rounding to float32 can give pi
        return dataclasses.replace(detections, boxes=boxes)

    def tell_notes(self) -> None:
        """Print the notes, once per process. Call it after reading points, because an error makes them moot."""
        for line in (*self.notes, *self._unknown_heading()):
            tell(line, once=True)

    def announce(self, points: np.ndarray) -> None:
        """Print what is done to clouds, of which ``points`` is the first, in the detector's frame."""
        self.tell_notes()
        if line := self.describe():
            tell(line)
        if line := sensor_mismatch(points, self.detector):
            tell(f"warning: {line}")

    def _unknown_heading(self) -> tuple[str, ...]:
        """A line if clouds are not rotated because only one of the headings is known."""
        unknown = [sensor.forward_rad is None for sensor in (self.data, self.detector)]
        if self.yaw_rad is not None or all(unknown) or not any(unknown):
            return ()
        whose = "their sensor" if unknown[0] else "the detector's sensor"
        why = f"since the heading of {whose} is unknown (forward_rad){self._expected_axis}"
        return (f"note: clouds are not rotated, {why}; --yaw-deg rotates them",)

    @property
    def _expected_axis(self) -> str:
        """The end of a line: the axis that points forward for the detector, if it is one."""
        ahead = self.detector.forward_rad
        axes = {0.0: "x", 90.0: "y", 180.0: "-x", -180.0: "-x", -90.0: "-y"}
        axis = None if ahead is None else axes.get(round(math.degrees(ahead), 2))
        return f": the detector expects {axis} ahead" if axis else ""

    def describe(self) -> str:
        """One line about what is done to the clouds; ``""`` for nothing."""
        if (pose := self.pose) is None:
            return ""
        turn = math.degrees(self.turn_rad)
        steps = [f"rotated by {turn:g} degrees"] if turn else []
        if (shift := pose[:3, 3]).any():
            steps.append(f"shifted by ({', '.join(f'{v:.2f}' for v in shift)}) m")
        return f"clouds {' and '.join(steps)}, and boxes transformed back{self._expected_axis if turn else ''}"


def heading(detector: Sensor, turn_rad: float) -> float | None:
    """Azimuth of the heading in clouds that are rotated by an angle for a detector; None if it is unknown."""
    return None if detector.forward_rad is None else math.remainder(detector.forward_rad - turn_rad, 2 * math.pi)


def align(
    detector: Sensor,
    sensor: Sensor | None = None,
    *,
    paths: Collection[Path] = (),
    yaw_rad: float | None = None,
    intensity_scale: float | None = None,
) -> Alignment:
    """Make the alignment of points to a detector. Read the points with its ``data``.

    Args:
        sensor: sensor that recorded the points; by default the sensor of the paths, by :func:`recorded_by` (which
            a note says), or the detector's.
        paths: point files, or recordings in folders.
        yaw_rad: rotation from the points to the detector, counter-clockwise, instead of the angle between
            headings.
        intensity_scale: factor from the intensity in files to the scale 0-255, instead of the sensor's.

    Raises:
        ValueError: files of different sensors, or an intensity scale for files that have their own.

    >>> from fcos_lidar_jax.sensors import KITTI_HDL64E, NUSCENES_HDL32E
    >>> aligned = align(NUSCENES_HDL32E, KITTI_HDL64E)
    >>> aligned.data.num_rows, aligned.data.intensity_scale, round(aligned.turn_rad, 4)
    (32, 255.0, 1.5708)
    """
    check_scale(intensity_scale, paths)
    recorded = recorded_by(paths) if sensor is None else sensor
    if recorded is not None:
        if recorded.forward_rad is None and yaw_rad is not None:
            recorded = dataclasses.replace(recorded, forward_rad=heading(detector, yaw_rad))
        data = in_frame_of(detector, recorded)
    else:  # the same place on the ego vehicle, in the axes of the points
        turn = yaw_rad or 0.0
        origin = np.array(detector.origin_m) @ about_z(turn)[:3, :3]
        data = dataclasses.replace(detector, origin_m=tuple(origin.tolist()), forward_rad=heading(detector, turn))
    if intensity_scale is not None:
        data = dataclasses.replace(data, intensity_scale=intensity_scale)
    first = next(iter(paths), None) if sensor is None else None
    file = first and sensor_file(first)
    notes: tuple[str, ...] = ()
    if recorded is not None and (first is None or file is not None):  # a path does not tell the number of rows
        notes = other_rows(recorded, detector)
    aligned = Alignment(data, detector, yaw_rad)
    if paths and recorded is None and yaw_rad is None and (axis := aligned._expected_axis):
        notes = (f"note: the heading of the clouds is not declared (--data-sensor, --yaw-deg){axis}",)
    if first is not None and recorded is not None and data != detector:
        told = f"recorded by {recorded.name}, as its {file.name if file else 'path'} says"
        scaled = f"intensities times {data.intensity_scale:g}"
        notes += (f"{first.parent}: {told}; override with --data-sensor: {scaled}",)
    return dataclasses.replace(aligned, notes=notes)


def other_rows(recorded: Sensor, detector: Sensor) -> tuple[str, ...]:
    """A warning if the sensor that recorded the points has another number of rows than the detector's."""
    if recorded.num_rows == detector.num_rows:
        return ()
    rows = f"{recorded.name} has {recorded.num_rows} rows, and the detector's sensor {detector.num_rows}"
    return (f"warning: {rows}: expect poor detections",)
