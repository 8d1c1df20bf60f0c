"""Simulated frames as a data set, made as they are asked for."""

import dataclasses

import numpy as np

from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.synthetic.frames import make_frame
from fcos_lidar_jax.sensors import Sensor


@dataclasses.dataclass(frozen=True)
class SimulatedFrames:
    """So many frames of :func:`make_frame`, each of another street, without the points on the carrying vehicle.

    The objects are near, and only those that enough points show are annotated: what a small detector can learn.
    Ten sweeps of hurried streets are a stress set for the fusion of sweeps: car and objects move fast, and most
    cells hold points of several sweeps.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> frames = SimulatedFrames(TINY, number=2)
    >>> len(frames), frames.frame(1).points.shape[1]
    (2, 5)
    """

    sensor: Sensor
    """Who looks."""
    number: int
    """Of frames."""
    first_seed: int = 0
    """Of the first frame; the others follow."""
    num_objects: int = 14
    """Of a street; fewer where there is no room."""
    reach_m: float = 10.0
    """They are placed along the street within this distance."""
    min_points: int = 5
    """Objects that fewer points of the current sweep show are not annotated."""
    close_m: float = 1.0
    """Half the side of the square around the sensor that is emptied, in each sweep's own frame."""
    num_sweeps: int = 1
    """Sweeps fused, the current one included."""
    hurry: bool = False
    """The car and most of the objects move fast."""

    def __len__(self) -> int:
        """Number of frames."""
        return self.number

    def frame(self, index: int) -> Frame:
        """One frame, simulated anew."""
        seed = self.first_seed + index
        frame = make_frame(
            seed,
            self.sensor,
            num_objects=self.num_objects,
            reach_m=self.reach_m,
            num_sweeps=self.num_sweeps,
            hurry=self.hurry,
            close_m=self.close_m,
        )
        shown = frame.num_points >= self.min_points
        return Frame(frame.points, frame.boxes[shown], frame.labels[shown], frame.num_points[shown])

    def labels(self, index: int) -> np.ndarray:
        """Labels of a frame's boxes; the frame is simulated for it."""
        return self.frame(index).labels

    def name(self, index: int) -> str:
        """What messages call a frame."""
        return f"seed {self.first_seed + index}"
