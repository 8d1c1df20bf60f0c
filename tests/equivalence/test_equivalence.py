"""Results do not depend on the number of devices; each test runs in a process with eight devices."""

import pytest
import quick
from commands import run_python

pytestmark = pytest.mark.slow

PREDICTIONS = """
import jax, numpy as np
from tiny_run import REFINED as CONFIG, SENSOR, FRAMES, weights
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.inference.prediction import predict
detector = TrainedDetector(build_detector(CONFIG, SENSOR), weights(CONFIG))
runs = []
for n in (1, 8):
    predictions = predict(detector, FRAMES, indices=range(11), devices=jax.devices()[:n])
    runs.append([p.detections for p in predictions])
assert len(jax.devices()) == 8 and all(len(run) == 11 for run in runs)
assert sum(int(d.valid.sum()) for d in runs[0]) > 20
for a, b in zip(*runs, strict=True):
    jax.tree.map(np.testing.assert_array_equal, a, b)
"""
GRADIENTS = """
import dataclasses, jax, linear_network, numpy as np, sys, tiny_run
from tiny_run import SENSOR, FRAMES, untrained
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import build_detector, convolution
from fcos_lidar_jax.devices.mesh import make_mesh, replicate, shard_batch
from fcos_lidar_jax.training.step import make_gradient
convolution.LARGE = 0  # the weight gradients of large images
CONFIG = {"network": tiny_run.CONFIG, "second look": tiny_run.REFINED}[sys.argv[1]]
if CONFIG.refinement:
    linear_network.use()
SENSOR = dataclasses.replace(SENSOR, num_columns=32)  # convolutions in float64 are slow
frames = [dataclasses.replace(FRAMES, sensor=SENSOR).frame(i) for i in range(8)]
for i, kept in ((0, 0), (2, 1)):  # one without boxes, one with a single one, and one without points
    annotated = {name: getattr(frames[i], name)[:kept] for name in ("boxes", "labels", "num_points")}
    frames[i] = dataclasses.replace(frames[i], **annotated)
frames[1] = dataclasses.replace(frames[1], points=frames[1].points[:0])
batch = make_batch(frames, max_points=CONFIG.max_points, max_boxes=CONFIG.max_boxes)
variables = jax.tree.map(np.float64, untrained(CONFIG, SENSOR))
gradient, runs = jax.jit(make_gradient(build_detector(CONFIG, SENSOR))), []  # traced once
for n in (1, 8):
    mesh = make_mesh(jax.devices()[:n])
    placed = replicate(variables, mesh)
    runs.append(jax.device_get(gradient(placed["params"], placed["batch_stats"], shard_batch(batch, mesh))))
one, eight = runs
assert int(one[2]["positives"]) > 20, int(one[2]["positives"])
for name in ("positives", "unique_positives", "positives_per_level", "candidates"):
    np.testing.assert_array_equal(one[2][name], eight[2][name])
for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(eight), strict=True):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * max(np.abs(a).max(), 1e-12))
"""

# A step under shard_map; tests/training/test_own_loop.py compares it with pmap.
MAPS = """
import dataclasses, jax, linear_network, numpy as np, optax, sys, tiny_peer
from jax.sharding import PartitionSpec
from tiny_run import CONFIG, SENSOR, FRAMES, untrained
from fcos_lidar_jax.input_pipeline.batching import make_batch
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.devices.mesh import make_mesh
from fcos_lidar_jax.training import make_state, make_train_step
linear_network.use()  # the convolutions are in the gradients of meshes
def double(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64 if leaf.dtype == np.float32 else None), tree)
def steps(config, n):
    batch = make_batch(frames, max_points=config.max_points, max_boxes=config.max_boxes)
    if config is peer:  # computes in the precision of its points; the projection takes float32
        batch = double(batch)
    detector = build_detector(config, SENSOR)
    optimizer = optax.sgd(0.1, 0.9)  # AdamW turns rounding of a gradient near zero into a full-size step
    step = make_train_step(detector, optimizer)
    state = make_state(detector, optimizer, jax.random.key(1), variables=double(untrained(config, SENSOR)))
    yield jax.jit(step)(state, batch)
    mesh = make_mesh(jax.devices()[:n])
    specs = {"in_specs": (PartitionSpec(), PartitionSpec("data")), "out_specs": PartitionSpec()}
    yield jax.jit(jax.shard_map(step, mesh=mesh, check_vma=False, **specs))(state, batch)
SENSOR = dataclasses.replace(SENSOR, num_columns=32)  # convolutions in float64 are slow
frames = [dataclasses.replace(FRAMES, sensor=SENSOR, number=8).frame(i) for i in range(8)]
frames[1] = dataclasses.replace(frames[1], points=frames[1].points[:0])
ours = dataclasses.replace(CONFIG, optimizer=dataclasses.replace(CONFIG.optimizer, batch_size=8, accumulate=2))
pillars = dataclasses.replace(tiny_peer.CONFIG.pillars, groups=(0, 1) * 5)  # with unequal numbers of boxes
peer = dataclasses.replace(tiny_peer.CONFIG, pillars=pillars)
config, n = {"ours": (ours, 4), "peer": (peer, 2)}[sys.argv[1]]
one, other = ((new.params, new.batch_stats, new.ema, metrics) for new, metrics in steps(config, n))
assert int(one[3]["dropped_points"]) > 0 and float(one[3]["gradient_norm"]) > 0
for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * max(np.abs(a).max(), 1e-12))
"""


@pytest.mark.parametrize(
    ("code", "what", "double", "level"),
    [
        (PREDICTIONS, "", False, None),
        (GRADIENTS, "network", True, 0),
        # Without optimisation, XLA rounds the two uses of a maximum differently, which cuts its gradient.
        (GRADIENTS, "second look", True, 1),
        (MAPS, "ours", True, 0),
        (MAPS, "peer", True, 1),
    ],
    ids=["predictions", "gradients", "gradients_of_the_second_look", "maps", "maps_of_centerpoint"],
)
def test_results_on_one_and_several_devices_are_equal(code, what, double, level):
    """Predictions are bit-identical; gradients, statistics and metrics of unequal samples agree in float64."""
    modes = {"JAX_ENABLE_X64": str(int(double)), "JAX_NUM_CPU_DEVICES": "8"}
    done = run_python("-c", code, what, **modes, **quick.environment(level is not None, level or 0))
    assert done.returncode == 0, done.stderr
