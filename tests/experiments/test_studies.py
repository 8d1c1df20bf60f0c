"""The study of equivalence, in its short form."""

import json

from commands import run_python


def test_five_steps_are_the_same_on_one_device_and_on_eight_in_two_processes(tmp_path):
    out = tmp_path / "record.json"
    done = run_python("-m", "experiments.studies.device_equivalence", "--quick", "--out", out)
    assert done.returncode == 0, done.stderr
    (mesh,) = json.loads(out.read_text())["meshes"]
    assert (mesh["devices"], mesh["processes"], mesh["dtype"]) == (8, 2, "float64")
    assert mesh["after_five_steps"] < 1e-9
