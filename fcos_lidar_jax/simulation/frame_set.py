"""Simulated frames as a data set, computed on access."""

import dataclasses

from fcos_lidar_jax import __version__
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading, Config
from fcos_lidar_jax.data.frame import Frame, FrameSet
from fcos_lidar_jax.fields import check_name
from fcos_lidar_jax.files import checksum
from fcos_lidar_jax.sensors import Sensor, load_sensor
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.simulation.streets import CITY, PLAIN, Streets

_OPTIONS = ("num_objects", "reach_m", "min_points", "reading", "fast_traffic", "streets")  # of make_frame


@dataclasses.dataclass(frozen=True)
class SimulatedFrames(FrameSet):
    """Frames of :func:`make_frame`, each of a different street, without points near the sensor.

    By default objects are near, and only objects with enough points are annotated, so that a small detector can
    learn from them. Ten sweeps of fast traffic are a stress test for sweep fusion: the ego vehicle and the objects
    move fast, and most cells hold points of several sweeps. Annotations depend on the points, so :meth:`truth`
    computes the whole frame.
    """

    sensor: Sensor
    number: int
    first_seed: int = 0  # seed of frame 0; frame i has seed first_seed + i
    num_objects: int = 14  # for this and the following fields see make_frame
    reach_m: float = 10.0
    min_points: int = 5
    reading: CloudReading = CloudReading()
    fast_traffic: bool = False
    streets: Streets = PLAIN
    classes = NUSCENES_CLASSES

    def __len__(self) -> int:
        return self.number

    def frame(self, index: int) -> Frame:
        return make_frame(self._seed(index), self.sensor, **{name: getattr(self, name) for name in _OPTIONS})

    def name(self, index: int) -> str:
        return f"seed {self._seed(index)}"

    def _seed(self, index: int) -> int:
        return self.first_seed + range(self.number)[index]

    def fingerprint(self) -> str:
        """Checksum of the fields and the package version, which determine all bytes of the frames."""
        return checksum(repr((__version__, self)).encode())


def city_frames(sensor: Sensor, number: int, first_seed: int = 0, *, streets: Streets = CITY) -> SimulatedFrames:
    """Training frames for a long-range sensor: varied streets with objects in the whole field of view."""
    extent = {"num_objects": 60, "reach_m": sensor.limit_xy_m, "min_points": 1}
    return SimulatedFrames(sensor, number, first_seed, **extent, streets=streets)


UNSEEN_SEED = 1_000_000  # first seed of test frames; seeds of training frames are smaller
SIMULATED_SPLITS = {"train": (100_000, 0), "val": (400, UNSEEN_SEED)}  # number of frames, first seed
_FULL_REACH_M = 45.0


def simulated_split(split: str, sensor: Sensor, reading: CloudReading) -> SimulatedFrames:
    """Streets that fit the sensor: plain streets for a short range, varied streets otherwise."""
    check_name("split", split, SIMULATED_SPLITS)
    make = SimulatedFrames if sensor.limit_xy_m < _FULL_REACH_M else city_frames
    return dataclasses.replace(make(sensor, *SIMULATED_SPLITS[split]), reading=reading)


def fresh_streets(config: Config, *, steps: int, seed: int = 0) -> tuple[Config, SimulatedFrames]:
    """Training frames without repetition, up to half a million, and a configuration for them.

    Args:
        config: configuration to adapt. The result has no class balance, copy-paste or augmentation, which are
            meant for few frames.
        seed: selects the frames from ``seed * steps * batch_size`` on. Different seeds give different streets for
            the same number of steps and fewer than half a million samples in total. Runs of different lengths may
            share streets.

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
    """Frames of streets that :func:`fresh_streets` never uses."""
    return SimulatedFrames(sensor, number, UNSEEN_SEED)
