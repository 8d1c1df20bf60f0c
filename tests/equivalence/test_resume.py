"""A killed and resumed run ends where the one left alone ends, to the bit: the short form of the experiment."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = "experiments.studies.kill_and_resume"
ROOT = Path(__file__).parents[2]
CACHE = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "jax")}
OPTIONS = {"cwd": ROOT, "env": {**os.environ, **CACHE}, "check": True, "timeout": 1000}


@pytest.mark.slow
def test_a_killed_run_ends_in_the_same_bits(tmp_path):
    out = tmp_path / "result.json"
    subprocess.run([sys.executable, "-m", SCRIPT, "--runs", "1", "--out", out], **OPTIONS)
    result = json.loads(out.read_text())
    assert (result["runs"], result["ended_the_same"]) == (1, 1)
    # It was killed after its first checkpoint and before its last.
    assert all(1 <= run["newest_checkpoint"] < result["steps"] for run in result["each"])
