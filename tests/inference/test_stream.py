"""A stream of sweeps: the window, and how often it is compiled."""

import dataclasses

import jax
import numpy as np
import pytest
from refusal import refused
from tiny_run import TINY_CONFIG, bits, untrained

from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.inference.cloud import make_cloud
from fcos_lidar_jax.inference.detector import _split_detect
from fcos_lidar_jax.inference.stream import detect_stream
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame
from fcos_lidar_jax.training.sharding import make_mesh


@pytest.fixture(scope="module")
def detector():
    config = dataclasses.replace(TINY_CONFIG, num_sweeps=2)
    return TrainedDetector(build_detector(config, TINY), untrained(config, TINY))


def drive(number):
    """Sweeps of different lengths, one and a half metres apart."""
    for index in range(number):
        pose = np.eye(4)
        pose[0, 3] = 1.5 * index
        yield Sweep(make_frame(index, TINY).points[index * 7 :], pose, 10**5 * index, f"sweep {index}")


def test_a_window_of_sweeps_moves_along_and_is_compiled_once(detector):
    sweeps, config = list(drive(4)), detector.config
    found = list(detect_stream(iter(sweeps), detector))
    assert [each.sweep.name for each in found] == [sweep.name for sweep in sweeps]
    for index, each in enumerate(found):
        window = sweeps[max(0, index - 1) : index + 1][::-1]
        mode = config.projection.remove_close
        points, _ = fuse_sweeps(window, TINY, remove_close=mode, close_m=config.projection.close_m)
        cloud = make_cloud(points, config, sensor=TINY, remove_close="none")
        assert bits((each.cloud.points, each.cloud.valid)) == bits((cloud.points, cloud.valid))
        assert bits(each.detections) == bits(detector.detect(cloud))
    assert _split_detect(detector.model, make_mesh(jax.local_devices()[:1]), 1)._cache_size() == 1


def test_a_window_of_one_sweep_forgets_the_others(detector):
    several = list(detect_stream(drive(3), detector, num_sweeps=1))
    for each, sweep in zip(several, drive(3), strict=True):
        [alone] = detect_stream([sweep], detector)
        assert bits(each.detections) == bits(alone.detections)


def test_boxes_come_before_the_next_sweep_is_asked_for(detector):
    def only_one():
        yield next(drive(1))
        raise AssertionError("asked for a second sweep")

    assert next(detect_stream(only_one(), detector)).sweep.name == "sweep 0"


@pytest.mark.parametrize("time_us", [0, -1])
def test_time_must_go_on(detector, time_us):
    first = next(drive(1))
    second = dataclasses.replace(first, time_us=time_us, name="late")
    with refused("late: time: got", f"{time_us} us", "sweep 0"):
        list(detect_stream([first, second], detector))
