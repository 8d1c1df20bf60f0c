"""Results do not depend on the number of devices or processes: the short form of the experiment."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "experiments" / "device_equivalence.py"


def test_a_step_is_the_same_on_one_device_and_on_eight_and_in_two_processes(tmp_path):
    out = tmp_path / "result.json"
    subprocess.run([sys.executable, SCRIPT, "--quick", "--out", out], check=True, timeout=1000)
    meshes = {(m["devices"], m["processes"], m["dtype"]): m for m in json.loads(out.read_text())["meshes"]}
    eight, apart = meshes[8, 1, "float32"], meshes[8, 2, "float64"]
    k = eight["k_of_samples"]
    assert k[0] == k[1] == 0
    assert max(k) > 5 * min(n for n in k if n)
    assert eight["targets_identical"]
    assert max(eight[part] for part in ("gradient", "statistics", "metrics")) < 1e-5
    assert apart["after_five_steps"] < 1e-9
