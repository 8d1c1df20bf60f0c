"""Results do not depend on the number of devices or processes: the short form of the experiment."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = "experiments.studies.device_equivalence"
ROOT = Path(__file__).parents[2]
CACHE = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "jax")}
OPTIONS = {"cwd": ROOT, "env": {**os.environ, **CACHE}, "check": True, "timeout": 1000}


@pytest.mark.slow
def test_a_step_is_the_same_on_one_device_and_on_eight_and_in_two_processes(tmp_path):
    out = tmp_path / "result.json"
    subprocess.run([sys.executable, "-m", SCRIPT, "--quick", "--out", out], **OPTIONS)
    meshes = {(m["devices"], m["processes"], m["dtype"]): m for m in json.loads(out.read_text())["meshes"]}
    eight, apart = meshes[8, 1, "float32"], meshes[8, 2, "float64"]
    k = eight["k_of_samples"]
    assert k[0] == k[1] == 0
    assert max(k) > 5 * min(n for n in k if n)
    assert eight["targets_identical"]
    assert max(eight[part] for part in ("gradient", "statistics", "metrics")) < 1e-5
    assert apart["after_five_steps"] < 1e-9
