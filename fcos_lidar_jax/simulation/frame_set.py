"""Simulated frames as a data set, made as they are asked for."""

import dataclasses

import numpy as np

from fcos_lidar_jax import __version__
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame


@dataclasses.dataclass(frozen=True)
class SimulatedFrames(FrameSet):
    """So many frames of :func:`make_frame`, each of another street, without the points on the ego vehicle.

    The objects are near, and only those that enough points show are annotated: what a small detector can learn.
    Ten sweeps of fast traffic are a stress set for the fusion of sweeps: ego vehicle and objects move fast, and
    most cells hold points of several sweeps.

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
    fast_traffic: bool = False
    """The ego vehicle and most of the objects move fast."""
    classes = NUSCENES_CLASSES

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
            fast_traffic=self.fast_traffic,
            close_m=self.close_m,
        )
        shown = frame.num_points >= self.min_points
        return dataclasses.replace(
            frame, boxes=frame.boxes[shown], labels=frame.labels[shown], num_points=frame.num_points[shown]
        )

    def labels(self, index: int) -> np.ndarray:
        """Labels of a frame's boxes; the frame is simulated for it."""
        return self.frame(index).labels

    def name(self, index: int) -> str:
        """What messages call a frame."""
        return f"seed {self.first_seed + index}"

    def fingerprint(self) -> str:
        """Checksum of the fields and the package's version, which decide every byte of the frames."""
        return checksum(repr((__version__, self)).encode())


UNSEEN_SEED = 1_000_000
"""Seeds of test frames start here; training frames never get that far."""


def fresh_streets(config: Config, *, steps: int, seed: int = 0) -> tuple[Config, SimulatedFrames]:
    """Training frames of which none is shown twice, and a configuration for them.

    Args:
        config: what makes more of few frames is taken out: class balance, copy-paste, augmentation.
        steps: of the run.
        seed: other seeds give other streets.

    >>> from fcos_lidar_jax.presets import QUICKSTART
    >>> config, frames = fresh_streets(QUICKSTART, steps=10)
    >>> config.augment, len(frames)
    (None, 20)
    """
    config = dataclasses.replace(config, copy_paste=None, class_balanced=False, augment=None)
    number = min(steps * config.optimizer.batch_size, UNSEEN_SEED // 2)
    first = seed * number % (UNSEEN_SEED - number)
    return config, SimulatedFrames(load_sensor(config.sensor), number, first)


def unseen_frames(sensor: Sensor, number: int) -> SimulatedFrames:
    """Streets that no training gets to see.

    >>> from fcos_lidar_jax.sensors import TINY
    >>> unseen_frames(TINY, 3).first_seed
    1000000
    """
    return SimulatedFrames(sensor, number, UNSEEN_SEED)
