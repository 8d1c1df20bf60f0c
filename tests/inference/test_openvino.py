"""Detectors whose network runs in OpenVINO: the boxes of XLA's, one cloud after the other."""

import dataclasses
import re
import sys
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import run_python
from tiny_run import TINY_CONFIG, bits, untrained

from fcos_lidar_jax.config import AugmentConfig
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.inference import TrainedDetector, load_detector
from fcos_lidar_jax.inference.openvino import processor_precision, with_openvino
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import TINY
from fcos_lidar_jax.simulation.frames import make_frame

pytest.importorskip("onnx", reason="onnx, of the extra cpu, is not installed")
pytest.importorskip("openvino", reason="openvino, of the extra cpu, is not installed")


@pytest.fixture(scope="module")
def trained():
    return TrainedDetector(build_detector(TINY_CONFIG, TINY), untrained(TINY_CONFIG, TINY))


@pytest.fixture(scope="module")
def fast(trained):
    return with_openvino(trained, precision="float32")


@pytest.mark.parametrize("axes", ["lidar", "ray"])
def test_boxes_are_those_of_xla_but_for_rounding(trained, axes):
    model = dataclasses.replace(TINY_CONFIG.model, regression_axes=axes)
    config = dataclasses.replace(TINY_CONFIG, model=model)
    here = TrainedDetector(build_detector(config, TINY), trained.variables)
    there = with_openvino(here, precision="float32")
    for seed in range(3):
        points = make_frame(seed, TINY).points
        ours, found = here(points), there(points)
        assert found.valid.any()
        np.testing.assert_array_equal(found.valid, ours.valid)
        np.testing.assert_allclose(found.scores, ours.scores, atol=1e-4)
        np.testing.assert_allclose(found.boxes, ours.boxes, atol=1e-3)
        assert found.num_dropped == ours.num_dropped


def test_a_batch_changes_nothing_and_no_cloud_overwrites_another(fast):
    clouds = [make_cloud(make_frame(seed, TINY).points, TINY_CONFIG, sensor=TINY) for seed in range(3)]
    points, valid = np.stack([cloud.points for cloud in clouds]), np.stack([cloud.valid for cloud in clouds])
    together = fast.program(make_mesh(), 3)(points, valid)
    alone = [fast.detect(cloud) for cloud in clouds]
    for row, found in enumerate(alone):
        assert bits(jax.tree.map(lambda leaf, row=row: leaf[row], jax.device_get(together))) == bits(found)
    assert len({bits(found)[0] for found in alone}) == 3


def test_bfloat16_where_the_processor_has_it(trained):
    flags = re.search(r"^flags.*", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    if flags is None:
        pytest.skip("not an x86 processor: its flags are not known")
    expected = "bfloat16" if {"avx512_bf16", "amx_bf16"} & {*flags[0].split()} else "float32"
    assert processor_precision() == with_openvino(trained).precision == expected


def test_other_post_processing_stays_in_openvino(fast):
    fewer, points = fast.with_inference(max_detections=3), make_frame(0, TINY).points
    assert (type(fewer), fewer.fingerprint) == (type(fast), fast.fingerprint)
    np.testing.assert_array_equal(fewer(points).scores, fast(points).scores[:3])
    with pytest.raises(ValueError, match=r"backend openvino: found inference\.flips x, expected none"):
        dataclasses.replace(
            fast, model=build_detector(dataclasses.replace(TINY_CONFIG, augment=AugmentConfig()), TINY)
        ).with_inference(flips="x")


def test_another_backend_or_precision_is_another_detector(trained, fast):
    rough = dataclasses.replace(fast, precision="bfloat16")
    assert len({trained.fingerprint, fast.fingerprint, rough.fingerprint}) == 3


@pytest.mark.parametrize("package", ["openvino", "onnx"])
def test_a_missing_package_is_one_line(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=rf"^{package} is not installed: pip install 'fcos-lidar-jax\[cpu\]'$"):
        load_detector("quickstart", backend="openvino")


def test_mirrored_views_are_refused(trained):
    config = dataclasses.replace(TINY_CONFIG, inference=dataclasses.replace(TINY_CONFIG.inference, flips="y"))
    mirrored = dataclasses.replace(trained, model=build_detector(config, TINY))
    with pytest.raises(ValueError, match=r"^backend openvino: found inference.flips y, expected none$"):
        with_openvino(mirrored)


def test_openvino_reports_nothing_to_anyone():
    """Its telemetry, a dependency, would fork the process and send."""
    code = """
        import os, sys
        os.register_at_fork(before=lambda: sys.exit("forked"))
        from fcos_lidar_jax.inference.onnx_graph import cpu_package
        cpu_package("openvino").Core()
        sys.exit("openvino_telemetry" in sys.modules)
    """
    assert run_python("-c", textwrap.dedent(code)).returncode == 0
