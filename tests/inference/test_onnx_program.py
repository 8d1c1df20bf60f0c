"""The ONNX graph from points to boxes finds the same boxes as XLA."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import CONFIG, REFINED, SENSOR, untrained

from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.inference.onnx_program import program_graph
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import sector
from fcos_lidar_jax.simulation.frames import make_frame

pytestmark = pytest.mark.slow

onnx = pytest.importorskip("onnx", reason="onnx, of the extra onnx, is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime, of the extra onnx, is not installed")


def tiny(config, sensor=SENSOR, **projection):
    config = dataclasses.replace(config, projection=dataclasses.replace(config.projection, **projection))
    return TrainedDetector(build_detector(config, sensor), untrained(config, sensor))


UNEVEN = tuple(angle + 0.003 * math.sin(9 * angle) for angle in SENSOR.inclinations_rad)


DETECTORS = {
    "quickstart": lambda: load_trained("quickstart"),
    "tiny with five rounds and a second look": lambda: tiny(REFINED, num_rounds=5),
    "tiny with a sector of uneven beams": lambda: tiny(
        CONFIG, sector(dataclasses.replace(SENSOR, inclinations_rad=UNEVEN), 0.3, SENSOR.num_columns // 2)
    ),
}


@pytest.mark.parametrize("name", DETECTORS)
def test_boxes_equal_xlas_except_for_rounding(name):
    detector = DETECTORS[name]()
    session = onnxruntime.InferenceSession(program_graph(detector), providers=["CPUExecutionProvider"])
    for seed in range(3):
        cloud = make_cloud(make_frame(seed, detector.sensor).points, detector.config, sensor=detector.sensor)
        boxes, scores, labels, used = session.run(None, {"points": cloud.points, "valid": cloud.valid})
        expected = detector.detect(cloud)
        assert used.tolist() == np.asarray(expected.valid).tolist()
        assert used.any()
        np.testing.assert_allclose(scores, expected.scores, atol=1e-4)
        # Boxes of nearly equal scores may change places.
        for box, score, label in zip(boxes[used], scores[used], labels[used], strict=True):
            near = (np.abs(expected.scores - score) < 1e-4) & (np.asarray(expected.labels) == label)
            assert np.abs(np.asarray(expected.boxes)[near] - box).max(axis=1).min() < 1e-3


def test_the_file_is_deterministic_and_describes_itself_and_unusable_rows_are_dropped():
    """Also points on the ego vehicle."""
    detector = tiny(CONFIG)
    content = program_graph(detector)
    assert program_graph(detector) == content
    about = {entry.key: json.loads(entry.value) for entry in onnx.load_model_from_string(content).metadata_props}
    assert about["classes"] == list(CONFIG.classes)
    assert about["sensor"]["num_columns"] == SENSOR.num_columns
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    cloud = make_cloud(make_frame(0, SENSOR).points, CONFIG, sensor=SENSOR)
    points, rows = cloud.points.copy(), np.flatnonzero(~cloud.valid)[:4]
    points[rows, :5] = [[0.1, 0, 0, 9, 0], [9, 9, np.nan, 9, 0], [9, 9, 0, 1e30, 0], [9, 9, 0, 9, -1]]
    clean, dirty = (
        session.run(None, {"points": p, "valid": valid})
        for p, valid in (
            (cloud.points, cloud.valid),
            (points, cloud.valid | np.isin(np.arange(len(points)), rows)),
        )
    )
    for a, b in zip(clean, dirty, strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_has_no_form_in_the_graph_is_refused():
    detector = tiny(CONFIG)
    prepare = detector.model.prepare
    model = detector.model._replace(prepare=lambda *cloud: jax.tree.map(jnp.tan, prepare(*cloud).features))
    with pytest.raises(ValueError, match=r"^ONNX: prepare: found the primitive tan, which has no rule$"):
        program_graph(dataclasses.replace(detector, model=model))
