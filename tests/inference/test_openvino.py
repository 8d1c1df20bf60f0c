"""Detectors whose network runs in OpenVINO find the same boxes as XLA's, one cloud after the other."""

import dataclasses
import re
import sys
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import run_python
from tiny_run import REFINED, SENSOR, bits, untrained

from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.inference import TrainedDetector, load_detector
from fcos_lidar_jax.inference.openvino import processor_precision, with_openvino
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.simulation.frames import make_frame

pytestmark = pytest.mark.slow

pytest.importorskip("onnx", reason="onnx, of the extra cpu, is not installed")
pytest.importorskip("openvino", reason="openvino, of the extra cpu, is not installed")


@pytest.fixture(scope="module")
def trained():
    return TrainedDetector(build_detector(REFINED, SENSOR), untrained(REFINED, SENSOR))


@pytest.fixture(scope="module")
def fast(trained):
    return with_openvino(trained, precision="float32")


def test_boxes_equal_xlas_except_for_rounding(trained, fast):
    for seed in range(3):
        points = make_frame(seed, SENSOR).points
        expected, detections = trained(points), fast(points)
        assert len(detections) == len(expected) > 0
        np.testing.assert_allclose(detections.scores, expected.scores, atol=1e-4)
        np.testing.assert_allclose(detections.boxes, expected.boxes, atol=1e-3)
        assert detections.counts == expected.counts


def test_in_bfloat16_the_offsets_between_points_are_still_float32():
    config = dataclasses.replace(REFINED, model=dataclasses.replace(REFINED.model, local_geometry=True))
    exact = TrainedDetector(build_detector(config, SENSOR), untrained(config, SENSOR))
    cloud = make_cloud(make_frame(0, SENSOR).points, config, sensor=SENSOR)
    image = exact.model.prepare(cloud.points, cloud.valid)
    rough, fine = (vars(with_openvino(exact, precision=p).network(image)) for p in ("bfloat16", "float32"))
    for name in fine:
        assert np.std(rough[name] - fine[name]) < 0.007 * np.std(fine[name])  # 0.010 with rounded offsets


def test_batched_detections_are_bit_identical_and_do_not_overwrite_each_other(fast):
    clouds = [make_cloud(make_frame(seed, SENSOR).points, REFINED, sensor=SENSOR) for seed in range(3)]
    points, valid = np.stack([cloud.points for cloud in clouds]), np.stack([cloud.valid for cloud in clouds])
    together = fast.program(make_mesh(), 3)(points, valid)
    separate = [fast.detect(cloud) for cloud in clouds]
    for row, detections in enumerate(separate):
        assert bits(jax.tree.map(lambda leaf, row=row: leaf[row], jax.device_get(together))) == bits(detections)
    assert len({bits(detections)[0] for detections in separate}) == 3


def test_bfloat16_is_used_if_the_processor_supports_it(trained):
    flags = re.search(r"^flags.*", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    if flags is None:
        pytest.skip("not an x86 processor: its flags are unknown")
    expected = "bfloat16" if {"avx512_bf16", "amx_bf16"} & {*flags[0].split()} else "float32"
    assert processor_precision() == with_openvino(trained).precision == expected


def test_other_post_processing_stays_in_openvino_and_flips_are_refused(trained, fast):
    fewer, points = fast.with_inference(max_detections=3), make_frame(0, SENSOR).points
    assert (type(fewer), fewer.fingerprint) == (type(fast), fast.fingerprint)
    np.testing.assert_array_equal(fewer(points).scores, fast(points).scores[:3])
    assert type(fast.without_second_look()) is type(fast)
    flippable = build_detector(dataclasses.replace(REFINED, augment=AugmentConfig()), SENSOR)
    with pytest.raises(ValueError, match=r"^backend openvino: found inference\.flips x, expected none$"):
        dataclasses.replace(fast, model=flippable).with_inference(flips="x")
    with pytest.raises(ValueError, match=r"^backend openvino: found inference\.flips y, expected none$"):
        with_openvino(dataclasses.replace(trained, model=flippable).with_inference(flips="y"))


def test_the_fingerprint_depends_on_backend_and_precision(trained, fast):
    rough = dataclasses.replace(fast, precision="bfloat16")
    assert len({trained.fingerprint, fast.fingerprint, rough.fingerprint}) == 3


def test_a_missing_package_is_reported_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(ValueError, match=r"^openvino is not installed: pip install -e '\.\[cpu\]' in"):
        load_detector("quickstart", backend="openvino")


def test_openvino_sends_no_telemetry():
    """Telemetry would fork the process."""
    code = """
        import os, sys
        os.register_at_fork(before=lambda: sys.exit("forked"))
        from fcos_lidar_jax.inference.onnx_graph import cpu_package
        cpu_package("openvino").Core()
        sys.exit("openvino_telemetry" in sys.modules)
    """
    assert run_python("-c", textwrap.dedent(code)).returncode == 0
