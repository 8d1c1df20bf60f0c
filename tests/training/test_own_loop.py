"""The script of docs/own_loop.md on two devices: own optimizer, loss, channel and data, in three forms."""

import re
from pathlib import Path

import pytest
import quick
from commands import run_python

PAGE = Path(__file__).parents[2] / "docs" / "own_loop.md"
SMALLER = """
import linear_network, tiny_run
from fcos_lidar_jax import presets, sensors
presets.QUICKSTART, sensors.SHORT_RANGE = tiny_run.CONFIG, tiny_run.SENSOR
linear_network.use()  # test_onnx_graph.py has a stem with a tenth channel
"""
CHECKS = """
assert mesh.size == 2
first, *others = ((state, metrics) for state, metrics in results.values())
for state, metrics in (first, *others):
    assert int(state.opt_state.gradient_step) == 1 and int(state.step) == 2
    assert float(metrics["learning_rate"]) == np.float32(1e-4) and float(metrics["loss/logit_size"]) > 0
    for name in ("loss/total", "loss/logit_size", "positives"):
        np.testing.assert_allclose(metrics[name], first[1][name], rtol=1e-4)
states = start, *(state for state, _ in (first, *others))
own, *trained = (np.asarray(state.params["predictions"]["kernel"])[-1] for state in states)
assert all((kernel != own).mean() > 0.9 for kernel in trained)  # the weights of the additional channel
"""


@pytest.mark.slow
def test_the_page_trains_alike_in_three_forms():
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE))
    done = run_python("-c", SMALLER + code + CHECKS, JAX_NUM_CPU_DEVICES="2", **quick.environment(True))
    assert done.returncode == 0, done.stderr[-3000:]
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["jit", "shard_map", "pmap"]
