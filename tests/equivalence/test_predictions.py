"""The boxes do not depend on the number of devices, to the bit."""

import os
import subprocess
import sys

CODE = """
import jax, numpy as np
from tiny_run import CONFIG, SENSOR, FRAMES, weights
from fcos_lidar_jax.inference import TrainedDetector
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.trainer import predict
detector = TrainedDetector(build_detector(CONFIG, SENSOR), weights())
runs = []
for n in (1, 2, 8):
    found = predict(detector, FRAMES, indices=range(11), devices=jax.devices()[:n])
    runs.append([p.detections for p in found])
assert len(jax.devices()) == 8 and all(len(run) == 11 for run in runs)
assert sum(int(d.valid.sum()) for d in runs[0]) > 20
for run in runs[1:]:
    for a, b in zip(runs[0], run, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)
"""


def test_predictions_on_one_two_and_eight_devices_are_bit_identical():
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": "8", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
