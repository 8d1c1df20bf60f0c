"""Streams of sweeps: the window of sweeps, rotations, and compilation."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from refusal import refused
from tiny_run import CONFIG, SENSOR, bits, untrained

from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.data.clouds import CloudFiles
from fcos_lidar_jax.data.sweeps import Sweep, fuse_sweeps
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.inference import detector as detectors
from fcos_lidar_jax.inference.alignment import align
from fcos_lidar_jax.inference.prediction import predict
from fcos_lidar_jax.inference.stream import detect_stream
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.simulation.frames import make_frame

FUSED = dataclasses.replace(CONFIG, num_sweeps=2, max_points=2048)


@pytest.fixture(scope="module")
def two_sweeps(detector):
    """A detector of two sweeps, with the network of one layer."""
    return TrainedDetector(build_detector(FUSED, SENSOR), detector.variables)


def drive(number):
    """Sweeps with different numbers of points, 1.5 m apart."""
    for index in range(number):
        pose = np.eye(4)
        pose[0, 3] = 1.5 * index
        yield Sweep(make_frame(index, SENSOR).points[index * 7 :], pose, 10**5 * index, f"sweep {index}")


def test_detections_in_a_rolling_window_are_bit_identical_and_compiled_once(two_sweeps):
    sweeps = list(drive(4))
    stream = list(detect_stream(iter(sweeps), two_sweeps))
    assert [each.sweep.name for each in stream] == [sweep.name for sweep in sweeps]
    for index, each in enumerate(stream):
        window = sweeps[max(0, index - 1) : index + 1][::-1]
        points, num_close = fuse_sweeps(window, SENSOR, FUSED.reading)
        cloud = make_cloud(points, FUSED, sensor=SENSOR, num_close=num_close)
        assert bits((each.cloud.points, each.cloud.valid)) == bits((cloud.points, cloud.valid))
        assert bits(each.detections) == bits(two_sweeps.detect(cloud))
    assert detectors._split_detect(two_sweeps.model, make_mesh(jax.local_devices()[:1]), 1)._cache_size() == 1


def test_sweeps_without_usable_points_have_no_boxes_and_a_line(two_sweeps):
    sweeps = list(drive(4))
    sweeps[0] = dataclasses.replace(sweeps[0], points=sweeps[0].points[:0])
    sweeps[2] = dataclasses.replace(sweeps[2], points=sweeps[2].points * np.float32(np.nan))
    far = dataclasses.replace(sweeps[2], points=sweeps[1].points + np.array([900, 0, 0, 0, 0], np.float32))
    *_, lost = detect_stream([*sweeps[:2], far], two_sweeps)
    assert (lost.note, lost.detections.valid.any()) == ("sweep 2: only older sweeps have usable points", False)
    stream = list(detect_stream(sweeps, two_sweeps))
    assert [each.note for each in stream] == [
        "sweep 0: no points in it, expected at least one",
        None,
        "sweep 2: only older sweeps have usable points",
        None,
    ]
    assert [bool(each.detections.valid.any()) for each in stream] == [False, True, False, True]
    reading = dataclasses.replace(FUSED.reading, num_sweeps=1)
    *_, third, last = detect_stream(sweeps, two_sweeps, reading=reading)
    assert third.note.startswith("sweep 2: none of its")
    [single] = detect_stream(sweeps[3:], two_sweeps)  # a window of one sweep ignores earlier sweeps
    assert bits(last.detections) == bits(single.detections)


def test_skipped_sweeps_are_fused_into_later_ones(two_sweeps):
    sweeps = list(drive(5))
    whole, at = list(detect_stream(sweeps, two_sweeps)), {sweeps[2].time_us, sweeps[3].time_us}
    some = list(detect_stream(sweeps, two_sweeps, at_us=at))
    assert [each.sweep.time_us for each in some] == sorted(at)
    for each, expected in zip(some, whole[2:4], strict=True):
        assert bits((each.cloud.points, each.detections)) == bits((expected.cloud.points, expected.detections))


def test_close_points_of_rotated_sweeps_are_removed_as_from_a_list_of_sweeps(detector, tmp_path):
    """The sensor is not at the origin of its frame."""
    yaw, sensor = 0.8, dataclasses.replace(SENSOR, origin_m=(1.0, -0.5, 0.2))
    config = dataclasses.replace(FUSED, projection=dataclasses.replace(FUSED.projection, remove_close="all"))
    detector = TrainedDetector(build_detector(config, sensor), untrained(config, sensor))
    aligned = align(sensor, yaw_rad=yaw)
    cos, sin = np.cos(yaw), np.sin(yaw)
    here = np.array([[cos, sin], [-sin, cos]]) @ sensor.origin_m[:2]  # before the rotation
    np.testing.assert_allclose(aligned.data.origin_m[:2], here)
    sweeps = [
        dataclasses.replace(s, points=np.concatenate([s.points, s.points[:5] * 0 + np.float32([*here, 0, 1, 0])]))
        for s in drive(2)
    ]
    entries = []
    for i, sweep in enumerate(sweeps):
        np.save(tmp_path / f"{i}.npy", sweep.points)
        pose = {"timestamp_us": sweep.time_us, "sensor_to_world": sweep.sensor_to_world.tolist()}
        entries.insert(0, {"file": f"{i}.npy", **pose})
    (tmp_path / "sweeps.json").write_text(json.dumps(entries))
    *_, found = detect_stream(sweeps, detector, yaw_rad=yaw)
    files = CloudFiles((tmp_path / "sweeps.json",), aligned.data, config.reading)
    [prediction] = predict(detector, files, yaw_rad=yaw)
    assert prediction.cloud.num_close == found.cloud.num_close >= 10
    assert bits((prediction.cloud.points, prediction.detections)) == bits((found.cloud.points, found.detections))
    rotated = files.frame(0).points[:1000, :2] @ np.array([[cos, sin], [-sin, cos]])
    np.testing.assert_allclose(found.cloud.points[:1000, :2], rotated, atol=1e-5)  # and not shifted


def test_boxes_are_returned_before_the_next_sweep_is_requested(two_sweeps):
    def only_one():
        yield next(drive(1))
        raise AssertionError("requested a second sweep")

    assert next(detect_stream(only_one(), two_sweeps)).sweep.name == "sweep 0"


@pytest.mark.parametrize("time_us", [0, -1])
def test_times_must_increase(two_sweeps, time_us):
    first = next(drive(1))
    second = dataclasses.replace(first, time_us=time_us, name="late")
    with refused("late: time: got", f"{time_us} us", "sweep 0"):
        list(detect_stream([first, second], two_sweeps))
