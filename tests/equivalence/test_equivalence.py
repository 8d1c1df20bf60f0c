"""Results do not depend on the number of devices; each test runs in a process with eight devices."""

import pytest
import quick
from commands import run_python

PREDICTIONS = """
import jax, numpy as np
from tiny_run import CONFIG, SENSOR, FRAMES, weights
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.inference.prediction import predict
detector = TrainedDetector(build_detector(CONFIG, SENSOR), weights())
runs = []
for n in (1, 2, 8):
    predictions = predict(detector, FRAMES, indices=range(11), devices=jax.devices()[:n])
    runs.append([p.detections for p in predictions])
assert len(jax.devices()) == 8 and all(len(run) == 11 for run in runs)
assert sum(int(d.valid.sum()) for d in runs[0]) > 20
for run in runs[1:]:
    for a, b in zip(runs[0], run, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)
"""
GRADIENTS = """
import dataclasses, jax, numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from tiny_run import CONFIG, SENSOR, FRAMES, weights
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import build_detector, convolution
from fcos_lidar_jax.devices.mesh import make_mesh, replicate, shard_batch
from fcos_lidar_jax.training.step import make_gradient
convolution.LARGE = 0  # the weight gradients of large images
frames = [FRAMES.frame(i) for i in range(8)]
for i, kept in ((0, 0), (2, 1)):  # one without boxes, one with a single one, and one without points
    annotated = {name: getattr(frames[i], name)[:kept] for name in ("boxes", "labels", "num_points")}
    frames[i] = dataclasses.replace(frames[i], **annotated)
frames[1] = dataclasses.replace(frames[1], points=frames[1].points[:0])
batch = make_batch(frames, max_points=CONFIG.max_points, max_boxes=CONFIG.max_boxes)
variables = jax.tree.map(np.float64, weights())
runs = []
for n in (1, 8):
    mesh = make_mesh(jax.devices()[:n])
    gradient = jax.jit(make_gradient(build_detector(CONFIG, SENSOR)),
                       out_shardings=NamedSharding(mesh, PartitionSpec()))
    placed = replicate(variables, mesh)
    runs.append(jax.device_get(gradient(placed["params"], placed["batch_stats"], shard_batch(batch, mesh))))
one, eight = runs
assert int(one[2]["positives"]) > 20, int(one[2]["positives"])
for name in ("positives", "unique_positives", "positives_per_level", "candidates"):
    np.testing.assert_array_equal(one[2][name], eight[2][name])
for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(eight), strict=True):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * max(np.abs(a).max(), 1e-12))
"""


@pytest.mark.parametrize(("code", "dtype"), [(PREDICTIONS, "float32"), (GRADIENTS, "float64")])
def test_results_on_one_and_eight_devices_are_equal(code, dtype):
    """Predictions are bit-identical; gradients, statistics and metrics of unequal samples agree in float64."""
    double = dtype == "float64"  # rounding and compiler optimisation do not matter
    modes = {"JAX_ENABLE_X64": str(int(double)), "JAX_NUM_CPU_DEVICES": "8"}
    done = run_python("-c", code, **modes, **quick.environment(double))
    assert done.returncode == 0, done.stderr
